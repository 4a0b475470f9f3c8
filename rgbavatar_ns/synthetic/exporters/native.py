"""A take in the project's own format: what training on any other format is measured against."""

from pathlib import Path

import torch

from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.native.writer import DatasetWriter
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.teeth import with_teeth
from rgbavatar_ns.synthetic.exporters.take import Take, TakeFrame


class NativeWriter:
    """FLAME with the teeth that importers add, theta and cameras as the take has them."""

    def __init__(self, dst: Path, take: Take) -> None:
        self._take = take
        arrays = with_teeth(take.arrays)
        self._layout = HeadModel(arrays).layout
        identity = torch.from_numpy(take.identity).float()
        self._writer = DatasetWriter(dst, arrays, identity, self._layout, take.width, take.height)

    def add(self, frame: TakeFrame) -> None:
        """One frame's image, theta and camera."""
        parts = {name: torch.from_numpy(part).float() for name, part in frame.theta.items()}
        theta = self._layout.join(parts)
        self._writer.add(TrackedFrame(frame.index, theta, frame.camera, frame.image_rgba))

    def finish(self) -> None:
        """dataset.json."""
        self._writer.finish(self._take.num_test_frames)
