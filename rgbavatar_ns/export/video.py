"""Frames to an MP4 file, with PyAV (FFmpeg's libraries come inside its wheel)."""

import os
from collections.abc import Iterable
from pathlib import Path

import av
import numpy as np


def write_video(path: Path, frames: Iterable[np.ndarray], frames_per_second: float = 25.0) -> int:
    """Encode RGB frames as H.264 and return their number.

    frames: uint8 [H, W, 3], all of one size; an odd size is padded by one pixel, as the codec
    asks. The file appears under its name only when it is complete.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial.mp4")
    count = 0
    with av.open(str(partial), "w", format="mp4") as container:
        stream = None
        for frame in frames:
            frame = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)))
            if stream is None:
                stream = container.add_stream("libx264", rate=round(frames_per_second))
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.options = {"crf": "18"}
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            container.mux(stream.encode(picture))
            count += 1
        if stream is not None:
            container.mux(stream.encode(None))
    os.replace(partial, path)
    return count
