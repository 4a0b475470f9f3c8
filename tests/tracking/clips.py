"""Clips that the tests write themselves, and where the real ones are if they are here."""

from pathlib import Path

import av
import numpy as np

REAL_CLIPS = Path(__file__).parents[2].parent / "shared" / "data"


def write_clip(path: Path, images: list[np.ndarray], codec: str = "mpeg4") -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = 4_000_000
        for image in images:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def gradient_images(count: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """Pictures whose level tells their number and whose left half is darker."""
    images = []
    for number in range(count):
        image = np.full((height, width, 3), 40 + 15 * number, np.uint8)
        image[:, : width // 2] //= 2
        images.append(image)
    return images
