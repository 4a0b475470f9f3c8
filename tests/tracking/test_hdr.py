"""HDR films in the colours of an ordinary screen; their signals are made by the standards here."""

from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest

from rgbavatar_ns.tracking.input.video import FrameSource


def _hlg(nits: np.ndarray) -> np.ndarray:
    """The signal that a reference display of 1000 nits shows so (BT.2100 table 5)."""
    shown = nits / 1000
    scene = shown * (shown @ (0.2627, 0.678, 0.0593))[..., None] ** (1 / 1.2 - 1)
    above = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * scene), above)


def _pq(nits: np.ndarray) -> np.ndarray:
    power = (nits / 10000) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)


@pytest.mark.parametrize(("signal_of", "transfer"), [(_hlg, 18), (_pq, 16)])
@pytest.mark.parametrize("pixel_format", ["yuv444p10le", "yuva444p10le"])
def test_hdr_films_have_the_colours_that_an_ordinary_screen_shows_them_in(
    tmp_path: Path, signal_of: Callable[[np.ndarray], np.ndarray], transfer: int, pixel_format: str
) -> None:
    # Grey, skin, a strong red, white and twice as bright: 203 nits are what white paper has.
    srgb = np.array([[128] * 3, [205, 150, 120], [190, 60, 50], [255] * 3, [0] * 3]) / 255
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    light = np.append(light, [[2.0] * 3], axis=0)
    to_bt2020 = [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
    red, green, blue = signal_of(np.maximum(203 * light @ np.transpose(to_bt2020), 1e-6)).T
    luma = 0.2627 * red + 0.678 * green + 0.0593 * blue
    planes = [64 + 876 * luma, 512 + 896 * (blue - luma) / 1.8814]
    planes += [512 + 896 * (red - luma) / 1.4746, np.full(6, 700)]
    with av.open(str(tmp_path / "hdr.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.height, stream.width, stream.pix_fmt = 16, 96, pixel_format
        frame = av.VideoFrame(96, 16, pixel_format)
        for plane, codes in zip(frame.planes, planes):
            row = np.repeat(np.round(codes).astype(np.uint16), 16)
            padded = np.zeros((16, plane.line_size // 2), np.uint16)
            padded[:, :96] = row
            plane.update(padded.tobytes())
        for tagged in (stream.codec_context, frame):
            tagged.color_trc, tagged.color_primaries = transfer, 9
            tagged.colorspace, tagged.color_range = 9, 1
        for packet in (*stream.encode(frame), *stream.encode()):
            container.mux(packet)
    for side in (None, 48):
        (film,) = FrameSource.open(tmp_path / "hdr.mkv").read(max_side=side)
        shown = film.image_rgb[4, film.image_rgb.shape[1] // 12 :: film.image_rgb.shape[1] // 6]
        expected = np.append(np.round(255 * srgb), [[255] * 3], axis=0)
        assert np.abs(shown - expected).max() <= 4, shown
        assert (film.alpha is None) == ("a" not in pixel_format)
        assert film.alpha is None or np.abs(film.alpha.astype(int) - 700 / 1023 * 255).max() <= 1
