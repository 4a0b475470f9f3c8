"""A tracked dataset as a performance."""

from pathlib import Path

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.drawing.compositing import composite_bytes
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.driving.sources.paced import RecordedSource

_WHITE = (1.0, 1.0, 1.0)


def dataset_source(
    folder: Path, frames_per_second: float, real_time: bool, with_images: bool
) -> RecordedSource:
    """All frames of a dataset, as many a second; raises UserError where it cannot be read."""
    dataset = load_dataset(folder)

    def frame(place: int, captured_s: float) -> PerformanceFrame:
        seen = composite_bytes(dataset.read_image(place), _WHITE) if with_images else None
        theta, time_s = dataset.theta[place], place / frames_per_second
        return PerformanceFrame(place, captured_s, time_s, theta=theta, image_rgb=seen)

    times_s = [place / frames_per_second for place in range(len(dataset))]
    return RecordedSource(times_s, frame, PerformerHead(dataset.layout, dataset.arrays), real_time)
