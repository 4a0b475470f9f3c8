"""Pictures of formats: every kind is read, and what is damaged or too large is told."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from rgbavatar_ns.data.image_headers import jpeg_header
from rgbavatar_ns.data.importers import frame_images
from rgbavatar_ns.data.importers.frame_images import (
    FrameImage,
    image_header,
    make_png,
)
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.jpeg import is_damaged_jpeg, is_truncated_jpeg
from rgbavatar_ns.data.png import decode_png_rgba
from tests.fuzz.attacks import turned


def save(path: Path, image: np.ndarray) -> Path:
    cv2.imwrite(str(path), image)
    return path


def decoded(frame_image: FrameImage) -> np.ndarray:
    header = image_header(frame_image.color)
    return decode_png_rgba(make_png(frame_image, (header.width, header.height)).encoded, "")


def test_all_kinds_of_pictures(tmp_path):
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5
    color = np.stack([grey, grey[::-1], grey[:, ::-1]], -1)
    sixteen = save(tmp_path / "16.png", color.astype(np.uint16) * 257)
    assert np.array_equal(decoded(FrameImage(sixteen))[..., :3], color[..., ::-1])
    one = save(tmp_path / "grey.png", grey)
    assert np.array_equal(decoded(FrameImage(one))[..., :3], np.repeat(grey[..., None], 3, -1))
    binary = save(tmp_path / "binary.png", (grey > 100).astype(np.uint8))
    with_mask = decoded(FrameImage(sixteen, alpha=binary, regions=(one,)))
    assert np.array_equal(with_mask[..., 3], np.where(grey > 100, grey, 0))
    with pytest.raises(UnusableFrameError, match="coloured"):
        decoded(FrameImage(one, alpha=sixteen))
    cmyk = tmp_path / "cmyk.jpg"
    Image.new("CMYK", (8, 6), (10, 20, 30, 40)).save(cmyk)
    with pytest.raises(UnusableFrameError, match="CMYK"):
        decoded(FrameImage(cmyk))
    with pytest.raises(UnusableFrameError, match="differ in size"):
        decoded(FrameImage(one, alpha=save(tmp_path / "other.png", grey[:4])))


def test_a_cut_outs_alpha_is_its_matte_whatever_its_colours_are(tmp_path):
    color = save(tmp_path / "color.png", np.full((6, 8, 3), 90, np.uint8))
    alpha = np.zeros((6, 8), np.uint8)
    alpha[:, 4:], alpha[0] = 255, 130
    for name, shade in (("matted", (200, 30, 10)), ("white", (255, 255, 255))):
        rgb = np.broadcast_to(np.uint8(shade), (6, 8, 3))
        matte = save(tmp_path / f"{name}.png", np.dstack([rgb, alpha]))
        assert np.array_equal(decoded(FrameImage(color, alpha=matte))[..., 3], alpha)
    opaque = save(
        tmp_path / "opaque.png", np.dstack([alpha, alpha, alpha, np.full_like(alpha, 255)])
    )
    assert np.array_equal(decoded(FrameImage(color, alpha=opaque))[..., 3], alpha)


def test_a_picture_cut_anywhere_is_told(tmp_path):
    color = np.random.default_rng(0).integers(0, 256, (40, 50, 4), dtype=np.uint8)
    for name in ("whole.png", "whole.jpg"):
        path = save(tmp_path / name, color if name.endswith("png") else color[..., :3])
        whole = path.read_bytes()
        decoded(FrameImage(path))
        for kept in range(0, len(whole) - 1, 61):
            path.write_bytes(whole[:kept])
            with pytest.raises(UnusableFrameError):
                decoded(FrameImage(path))


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("part", ["color", "alpha", "region"])
def test_pictures_whose_header_promises_too_much_are_not_decoded(
    part, suffix, tmp_path, monkeypatch
):
    small = save(tmp_path / "small.png", np.zeros((6, 8, 3), np.uint8))
    other = save(tmp_path / f"other.{suffix}", np.zeros((60, 80, 3), np.uint8))
    huge = save(tmp_path / f"huge.{suffix}", np.zeros((60, 80, 3), np.uint8))
    content = bytearray(huge.read_bytes())
    place, side = (16, 4) if suffix == "png" else (content.index(b"\xff\xc0") + 5, 2)
    content[place : place + 2 * side] = 2 * (9000).to_bytes(side, "big")
    huge.write_bytes(content)
    frames = {
        "color": lambda path: FrameImage(path, alpha=small),
        "alpha": lambda path: FrameImage(small, alpha=path),
        "region": lambda path: FrameImage(small, regions=(small, path)),
    }
    decoder = frame_images.is_damaged_jpeg if suffix == "jpg" else frame_images.decode_png_rgba

    def refuse(encoded: bytes, *rest: str) -> object:
        assert len(encoded) not in (len(content), other.stat().st_size), "it is decoded"
        return decoder(encoded, *rest)

    monkeypatch.setattr(frame_images, decoder.__name__, refuse)
    with pytest.raises(UnusableFrameError, match="differ in size"):
        make_png(frames[part](other), (8, 6))
    with pytest.raises(UnusableFrameError, match="more than 8192 x 8192"):
        make_png(frames[part](huge), (9000, 9000) if part == "color" else (8, 6))


def test_a_matte_that_exif_turns_is_turned_as_ever(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    mask = np.zeros((16, 8), np.uint8)
    mask[:8] = 255
    Image.fromarray(mask).save(tmp_path / "mask.jpg", exif=exif)
    color = save(tmp_path / "color.png", np.zeros((8, 16, 3), np.uint8))
    alpha = decoded(FrameImage(color, alpha=tmp_path / "mask.jpg"))[..., 3]
    assert (alpha[:, 8:] > 250).all()
    assert (alpha[:, :8] < 5).all()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", range(10))
def test_the_header_tells_a_turned_jpegs_size_as_opencv_decodes_it(orientation, order, tmp_path):
    exif = Image.Exif()
    exif.endian = order
    exif[0x010F], exif[0x0112], exif[0x0131] = "before", orientation, "behind"
    path = tmp_path / "turned.jpg"
    corner = np.zeros((48, 64, 3), np.uint8)
    corner[:24, :32] = 255
    Image.fromarray(corner).save(path, exif=exif, xmp=b"<x/>", comment="turned")
    upright = cv2.imread(str(path))
    header = image_header(path)
    assert (header.height, header.width) == upright.shape[:2]
    assert np.array_equal(decoded(FrameImage(path))[..., 2::-1], upright)


def test_exif_data_cut_anywhere_is_no_error():
    exif = Image.Exif()
    exif[0x0112] = 6
    file = io.BytesIO()
    Image.new("RGB", (64, 48)).save(file, "JPEG", exif=exif)
    whole = file.getvalue()
    start = whole.index(b"\xff\xe1")
    length = int.from_bytes(whole[start + 2 : start + 4], "big")
    for kept in range(2, length):
        cut = whole[: start + 2] + kept.to_bytes(2, "big") + whole[start + 4 : start + 2 + kept]
        header = jpeg_header(cut + whole[start + 2 + length :])
        assert header is not None
        assert sorted(header[:2]) == [48, 64], kept


def _jpegs() -> dict[str, bytes]:
    """A portrait's colours in the kinds of JPEG that there are."""
    x, y = np.meshgrid(np.linspace(-1, 1, 96), np.linspace(-1, 1, 80))
    noise = np.random.default_rng(0).normal(0, 6, (80, 96, 3))
    color = np.stack([200 - 90 * x, 150 + 80 * y, 120 + 60 * np.hypot(x, y)], -1) + noise
    image = Image.fromarray(color.clip(0, 255).astype(np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 3
    made = {
        "usual": (image, {}),
        "4:4:4": (image, {"subsampling": 0, "quality": 98}),
        "4:2:2": (image, {"subsampling": 1}),
        "progressive": (image, {"progressive": True}),
        "optimised": (image, {"optimize": True}),
        "restarts": (image, {"restart_marker_blocks": 4}),
        "with EXIF and a profile": (image, {"exif": exif, "icc_profile": bytes(70_000)}),
        "grey": (image.convert("L"), {}),
        "tiny": (image.resize((1, 1)), {}),
    }
    encoded = {}
    for name, (picture, options) in made.items():
        file = io.BytesIO()
        picture.save(file, "JPEG", **options)
        encoded[name] = file.getvalue()
    return encoded


def test_whole_jpegs_of_all_kinds_pass_and_some_turned_bits_are_told():
    told = 0
    for name, whole in _jpegs().items():
        assert not is_damaged_jpeg(whole), name
        if name in ("usual", "progressive"):
            generator = np.random.default_rng(1)
            for _ in range(100):
                told += is_damaged_jpeg(turned(whole, generator, bits=1))
    # Without checksums most turned bits are another picture.
    assert told > 40


def test_a_jpeg_cut_anywhere_is_told_and_none_that_shows_all_of_the_picture():
    jpegs = _jpegs()
    thumbnail = jpegs["tiny"]
    block = b"Exif\0\0" + thumbnail + b"\xff\xd9"
    segment = b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block
    usual = jpegs["usual"]
    jpegs["with a thumbnail"] = usual[:2] + segment + usual[2:]
    for name, whole in jpegs.items():
        for more in (b"", bytes(5000), b"\xff\xff", b"the camera's notes", usual):
            assert not is_truncated_jpeg(whole + more), (name, more)
        assert not is_truncated_jpeg(whole[:-2]), f"{name}: nothing but the end's marker is missing"
        if name == "tiny":
            continue
        for share in (0.1, 0.3, 0.5, 0.8, 0.95):
            cut = whole[: int(share * len(whole))]
            rest = bytes(len(whole) - len(cut))
            for broken in (cut, cut + rest, cut + b"\xff"):
                assert is_truncated_jpeg(broken), (name, share, len(broken))
                assert is_damaged_jpeg(broken), (name, share, len(broken))
