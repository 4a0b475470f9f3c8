"""A tracked dataset as a performance."""

from pathlib import Path

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.drawing.compositing import composite_bytes
from rgbavatar_ns.drawing.contact_sheet import scaled
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.driving.sources.paced import RecordedSource

_WHITE = (1.0, 1.0, 1.0)


def dataset_source(
    folder: Path, frames_per_second: float | None, real_time: bool, image_height_px: int | None
) -> RecordedSource:
    """A dataset's frames of its first camera, at this rate or, by default, at the film's own.

    Each comes when it was filmed: those that are not in the dataset leave a gap. Raises UserError
    where it cannot be read. image_height_px: of the pictures that frames bring along; without it
    they bring none.
    """
    dataset = load_dataset(folder)
    places, moments = dataset.films[0], dataset.moments
    rate = frames_per_second or dataset.playback_rate
    times_s = [(moments[place] - moments[places[0]]) / rate for place in places]

    def frame(number: int, captured_s: float) -> PerformanceFrame:
        place = places[number]
        seen = None
        if image_height_px is not None:
            seen = composite_bytes(dataset.read_image(place), _WHITE)
            seen = scaled(seen, image_height_px / len(seen))
        return PerformanceFrame(
            number, captured_s, times_s[number], theta=dataset.theta[place], image_rgb=seen
        )

    return RecordedSource(times_s, frame, PerformerHead(dataset.layout, dataset.arrays), real_time)
