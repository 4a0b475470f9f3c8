"""Frames that arrive while an avatar is being trained: sources, their format, and the pools."""

from rgbavatar_ns.data.streams.backoff import Backoff
from rgbavatar_ns.data.streams.client import StreamClient
from rgbavatar_ns.data.streams.ingest import Ingest
from rgbavatar_ns.data.streams.protocol import FrameStream, Rewindable, StreamedFrame, StreamSubject
from rgbavatar_ns.data.streams.replay import ReplayStream
from rgbavatar_ns.data.streams.replay_buffer import ReplayBatch, ReplayBuffer
from rgbavatar_ns.data.streams.socket_server import SocketStream

__all__ = [
    "Backoff",
    "FrameStream",
    "Ingest",
    "ReplayBatch",
    "ReplayBuffer",
    "ReplayStream",
    "Rewindable",
    "SocketStream",
    "StreamClient",
    "StreamSubject",
    "StreamedFrame",
]
