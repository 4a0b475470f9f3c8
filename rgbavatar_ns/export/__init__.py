"""Taking the avatar away: pictures and videos of it."""

from rgbavatar_ns.export.comparison import comparison_frames, write_comparison
from rgbavatar_ns.export.video import write_video

__all__ = ["comparison_frames", "write_comparison", "write_video"]
