"""A video in, a tracked dataset out."""

from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.track import track_video

__all__ = ["TrackConfig", "track_video"]
