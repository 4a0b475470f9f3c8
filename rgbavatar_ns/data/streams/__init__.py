"""Frames that arrive while an avatar is being trained: sources, their format, and the pools."""

from rgbavatar_ns.data.streams.backoff import Backoff
from rgbavatar_ns.data.streams.client import StreamClient
from rgbavatar_ns.data.streams.folder import FolderStream, FolderWriter
from rgbavatar_ns.data.streams.ingest import Ingest
from rgbavatar_ns.data.streams.protocol import FrameStream, Rewindable, StreamedFrame, StreamSubject
from rgbavatar_ns.data.streams.replay import ReplayStream
from rgbavatar_ns.data.streams.replay_buffer import ReplayBatch, ReplayBuffer
from rgbavatar_ns.data.streams.socket_server import PushedStream

__all__ = [
    "Backoff",
    "FolderStream",
    "FolderWriter",
    "FrameStream",
    "Ingest",
    "PushedStream",
    "ReplayBatch",
    "ReplayBuffer",
    "ReplayStream",
    "Rewindable",
    "StreamClient",
    "StreamSubject",
    "StreamedFrame",
]
