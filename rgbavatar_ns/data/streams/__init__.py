"""Frames that arrive while an avatar is being trained: sources, their format, and the pools."""

from rgbavatar_ns.data.streams.backoff import Backoff
from rgbavatar_ns.data.streams.client import StreamClient
from rgbavatar_ns.data.streams.folder import FolderStream, FolderWriter
from rgbavatar_ns.data.streams.ingest import Ingest
from rgbavatar_ns.data.streams.pooled import FramePools, PooledBatch
from rgbavatar_ns.data.streams.protocol import FrameStream, Rewindable, StreamedFrame, StreamSubject
from rgbavatar_ns.data.streams.pushed import PushedStream
from rgbavatar_ns.data.streams.replay import ReplayStream

__all__ = [
    "Backoff",
    "FolderStream",
    "FolderWriter",
    "FramePools",
    "FrameStream",
    "Ingest",
    "PooledBatch",
    "PushedStream",
    "ReplayStream",
    "Rewindable",
    "StreamClient",
    "StreamSubject",
    "StreamedFrame",
]
