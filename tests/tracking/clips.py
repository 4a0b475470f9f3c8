"""Clips that the tests write themselves, and where the real ones are if they are here."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

REAL_CLIPS = Path(__file__).parents[2].parent / "shared" / "data"


def write_clip(
    path: Path,
    images: list[np.ndarray],
    codec: str = "mpeg4",
    pixel_format: str = "yuv420p",
    times_ms: Sequence[int] | None = None,
    pixel_aspect: Fraction | None = None,
) -> Path:
    """Encode pictures at 25 frames/s, or at the given times."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixel_format
        stream.bit_rate = 4_000_000
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        if times_ms is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for number, image in enumerate(images):
            layout = "rgba" if image.shape[2] == 4 else "rgb24"
            frame = av.VideoFrame.from_ndarray(image, format=layout)
            if times_ms is not None:
                frame.pts, frame.time_base = times_ms[number], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def gradient_images(count: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """Pictures whose level tells their number and whose left half is darker."""
    images = []
    for number in range(count):
        image = np.full((height, width, 3), 40 + 15 * number, np.uint8)
        image[:, : width // 2] //= 2
        images.append(image)
    return images


def astronaut() -> np.ndarray:
    """A public-domain portrait that scikit-image carries, cut to head and shoulders."""
    skimage = pytest.importorskip("skimage.data", reason="scikit-image is not installed")
    return skimage.astronaut()[:400, 30:430]
