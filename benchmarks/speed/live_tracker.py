"""Frames per second of the live tracker on a video, warm-up apart.

python benchmarks/speed/live_tracker.py me.mp4 --height-px 512 --frames 75
"""

import statistics
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import tyro

from rgbavatar_ns.errors import told_without_traceback
from rgbavatar_ns.options import CheckedOptions, Count, Pixels
from rgbavatar_ns.tracking import TrackConfig
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.live import LiveTracker


@dataclass
class Options(CheckedOptions):
    """What is tracked."""

    video: Annotated[Path, tyro.conf.Positional]
    height_px: Pixels = 512
    """Height that frames are brought to, and side of the pictures cut out."""
    frames: Count = 75


def main(options: Options) -> None:
    """Track the first frames and print the median time of one."""
    seconds: list[float] = []
    with closing(LiveTracker(TrackConfig(image_size=options.height_px))) as tracker:
        for frame in FrameSource.open(options.video, options.frames):
            height, width = frame.image_rgb.shape[:2]
            size = (round(width * options.height_px / height), options.height_px)
            image = cv2.resize(frame.image_rgb, size)
            ready, started = tracker.ready, time.perf_counter()
            tracker(image)
            if ready:
                seconds.append(time.perf_counter() - started)
        counts = dict(tracker.counts)
    if not seconds:
        raise SystemExit("The video ended before the warm-up did; pass more --frames.")
    middle = statistics.median(seconds)
    print(f"{1 / middle:.1f} frames/s, {1e3 * middle:.0f} ms a frame (median); {counts}")


if __name__ == "__main__":
    with told_without_traceback("live_tracker.py"):
        main(tyro.cli(Options, description=__doc__))
