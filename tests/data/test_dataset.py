import json
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from rgbavatar_ns.data import DatasetWriter, is_dataset, load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA
from tests.data.small_dataset import (
    CAMERA_PARTS,
    HEIGHT,
    NUM_FRAMES,
    NUM_TEST,
    WIDTH,
    frame,
    odd_camera,
    small_dataset,
    small_writer,
)


@pytest.fixture
def folder(tmp_path, head) -> Path:
    small_dataset(tmp_path / "data", head)
    return tmp_path / "data"


@pytest.fixture
def writer(tmp_path, head) -> DatasetWriter:
    """One that has its first frame."""
    writer = small_writer(tmp_path, head)
    writer.add(frame(head, 0))
    return writer


def edit_index(folder: Path, **changes) -> None:
    path = folder / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def error_of(folder: Path) -> UserError:
    with pytest.raises(UserError) as caught:
        load_dataset(folder)
    assert caught.value.cause
    assert caught.value.remedy
    return caught.value


def test_the_films_rate_is_kept_and_25_where_there_is_none(tmp_path, head, folder):
    plain = load_dataset(folder)
    assert (plain.frames_per_second, plain.playback_rate) == (None, 25)
    size = (WIDTH, HEIGHT)
    writer = DatasetWriter(
        tmp_path / "film", head.arrays, plain.identity, head.layout, *size, frames_per_second=29.97
    )
    writer.add(frame(head, 0))
    film = writer.finish(0)
    assert (film.frames_per_second, film.playback_rate) == (29.97, 29.97)


@pytest.mark.parametrize("rate", [0, -25, 1e9, "25", None, True, [25]])
def test_a_rate_that_is_none_is_told(folder, rate):
    edit_index(folder, frames_per_second=rate)
    assert "frames_per_second" in error_of(folder).cause


def test_of_several_cameras_one_film_is_taken(folder):
    dataset = load_dataset(folder)
    assert dataset.of_one_camera([1, 0]) == (1, 0)
    several = replace(dataset, camera_names=tuple("ab"[k % 2] for k in range(len(dataset))))
    assert several.of_one_camera(range(1, len(dataset))) == tuple(range(1, len(dataset), 2))
    assert several.of_one_camera([]) == ()


def test_what_is_written_is_read_bit_for_bit(tmp_path, head):
    small_dataset(tmp_path / "data", head, per_frame_camera=True)
    dataset = load_dataset(tmp_path / "data")
    assert len(dataset) == NUM_FRAMES
    assert (dataset.width, dataset.height) == (WIDTH, HEIGHT)
    assert torch.equal(dataset.identity, torch.linspace(-1, 1, head.num_identity) / 3)
    assert dataset.layout == head.layout
    for position in range(NUM_FRAMES):
        expected = frame(head, position, per_frame_camera=True)
        assert dataset.frame_index[position] == position
        assert torch.equal(dataset.theta[position], expected.theta)
        for part in CAMERA_PARTS:
            written, read = getattr(expected.camera, part)[0], getattr(dataset.cameras, part)
            assert torch.equal(read[position], written)
        assert np.array_equal(dataset.read_image(position), expected.image_rgba)


def test_marks_of_what_nobody_filmed_come_back_and_older_versions_have_none(tmp_path, head):
    """The same files, with an index of version 1: what looks like marks is background."""
    writer = small_writer(tmp_path / "data", head)
    frames = [frame(head, index) for index in range(3)]
    frames[1].image_rgba[5:] = UNFILMED_RGBA
    for one in frames:
        writer.add(one)
    dataset = writer.finish(1)
    index = json.loads((tmp_path / "data/dataset.json").read_text())
    assert (index["version"], index["unfilmed"]) == (3, True)
    for position, one in enumerate(frames):
        assert np.array_equal(dataset.read_image(position), one.image_rgba)
    edit_index(tmp_path / "data", version=1)
    older = load_dataset(tmp_path / "data").read_image(1)
    assert not older[5:].any()
    assert np.array_equal(older[:5], frames[1].image_rgba[:5])
    assert np.array_equal(load_dataset(tmp_path / "data").read_image(0), frames[0].image_rgba)


def test_without_marks_a_dataset_stays_of_the_version_that_it_was(folder):
    index = json.loads((folder / "dataset.json").read_text())
    assert (index["version"], "unfilmed" in index) == (1, False)


def test_one_camera_for_all_frames_is_written_once_and_read_for_each(folder):
    index = json.loads((folder / "dataset.json").read_text())
    assert "camera" in index
    assert all("camera" not in record for record in index["frames"])
    cameras = load_dataset(folder).cameras
    assert torch.equal(cameras.focal_px, odd_camera().focal_px.expand(NUM_FRAMES, 2))


def test_the_last_frames_are_held_out(folder):
    dataset = load_dataset(folder)
    assert dataset.train + dataset.test == tuple(range(NUM_FRAMES))
    assert len(dataset.test) == NUM_TEST


def test_images_on_disk_are_straight_alpha_in_rgb_order(tmp_path, head):
    half_red = np.broadcast_to(np.uint8([200, 10, 0, 128]), (HEIGHT, WIDTH, 4)).copy()
    writer = small_writer(tmp_path, head)
    writer.add(replace(frame(head, 0), image_rgba=half_red))
    writer.finish(0)
    assert Image.open(tmp_path / "images/00000.png").getpixel((3, 3)) == (200, 10, 0, 128)


def test_another_head_travels_with_the_dataset(tmp_path, head):
    other = replace(head.arrays, name="mine", v_template=head.arrays.v_template * np.float32(2))
    identity = torch.zeros(head.num_identity)
    writer = DatasetWriter(tmp_path, other, identity, head.layout, WIDTH, HEIGHT)
    writer.add(frame(head, 0))
    dataset = writer.finish(0)
    assert dataset.arrays.name == "mine"
    assert np.array_equal(dataset.arrays.v_template, other.v_template)


def test_an_unfinished_dataset_is_none(writer, tmp_path):
    assert "dataset.json" in error_of(tmp_path).cause


def test_an_interrupted_overwriting_leaves_no_mixture(folder, head):
    with pytest.raises(UserError, match="not empty"):
        small_writer(folder, head)
    load_dataset(folder)
    small_writer(folder, head, overwrite=True).add(frame(head, 0))
    assert "dataset.json" in error_of(folder).cause
    writer = small_writer(folder, head)
    writer.add(frame(head, 3))
    assert writer.finish(0).frame_index == (3,)


def test_overwriting_touches_only_what_a_writer_has_written(folder, head):
    theirs = {"notes.txt": "mine", "images/me.png": "my picture", "images/1.png": "mine too"}
    for name, text in theirs.items():
        (folder / name).write_text(text)
    writer = small_writer(folder, head, overwrite=True)
    writer.add(frame(head, 0))
    writer.finish(0)
    assert {name: (folder / name).read_text() for name in theirs} == theirs
    assert sorted(path.name for path in folder.glob("images/0*.png")) == ["00000.png"]


@pytest.mark.parametrize("index", [None, "{}", '{"format": "INSTA"}', "damaged"])
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_other_things_is_refused_and_stays(tmp_path, head, index, overwrite):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "00000.png").write_text("my picture")
    if index is not None:
        (tmp_path / "dataset.json").write_text(index)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match="not empty"):
        small_writer(tmp_path, head, overwrite=overwrite)
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "images" / "00000.png").read_text() == "my picture"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"theta": torch.zeros(3)}, "3 values"),
        ({"theta": torch.full((HeadModel.embedded().layout.size,), torch.nan)}, "NaN"),
        ({"image_rgba": np.zeros((HEIGHT, WIDTH + 1, 4), np.uint8)}, "not 12 x 8"),
        ({"index": 0}, "two frames 0"),
    ],
)
def test_a_frame_that_does_not_fit_is_refused(writer, head, change, words):
    with pytest.raises(UserError, match=words):
        writer.add(replace(frame(head, 1), **change))


def test_holding_out_every_frame_is_refused(writer):
    with pytest.raises(UserError, match="held out"):
        writer.finish(1)


def test_paths_of_any_length_are_told(tmp_path, folder):
    assert "does not exist" in error_of(tmp_path / ("n" * 5000)).cause
    frames = json.loads((folder / "dataset.json").read_text())["frames"]
    frames[1]["image"] = "n" * 5000
    edit_index(folder, frames=frames)
    assert "cannot be read" in error_of(folder).cause


@pytest.mark.parametrize("name", ["images/00001.png", "theta.npy", "dataset.json"])
def test_a_pipe_in_the_place_of_a_file_is_told(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    assert "no regular file" in error_of(folder).cause


def test_missing_or_empty_folder(tmp_path):
    assert "does not exist" in error_of(tmp_path / "none").cause
    assert "is empty" in error_of(tmp_path).cause
    (tmp_path / "file").write_text("x")
    assert "is a file" in error_of(tmp_path / "file").cause


def with_nan(theta: np.ndarray) -> np.ndarray:
    theta[4, 3] = np.nan
    return theta


@pytest.mark.parametrize(
    ("changed", "causes"),
    [
        (with_nan, ["1 of 7 frames (4)"]),
        (lambda theta: theta[:, :5], ["(7, 5)", str(HeadModel.embedded().layout.size)]),
        (lambda theta: theta + 1e5, ["no person can do in frame 0: expression"]),
        (lambda theta: np.array([{"a": 1}], dtype=object), ["theta.npy"]),
    ],
    ids=["NaN", "another size", "absurd", "needs pickle"],
)
def test_a_theta_that_cannot_be_used(folder, changed, causes):
    path = folder / "theta.npy"
    np.save(path, changed(np.load(path)), allow_pickle=True)
    cause = error_of(folder).cause
    assert all(part in cause for part in causes)


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"layout": HeadModel.embedded().layout.to_json()[1:]}, HeadModel.embedded().layout.size),
        ({"version": 99}, 99),
        ({"format": "other"}, "format"),
        ({"head": "flame2020"}, "flame2020"),
        ({"test_frames": NUM_FRAMES}, "holds out"),
        ({"test_frames": True}, "holds out"),
        ({"version": True}, "version True"),
        ({"width": 10**9}, "width"),
        ({"identity": [True] * HeadModel.embedded().num_identity}, "identity"),
        ({"frames": []}, "no frames"),
    ],
)
def test_an_index_that_cannot_be_used(folder, changes, cause):
    edit_index(folder, **changes)
    assert str(cause) in error_of(folder).cause


def test_duplicate_frame_number(folder):
    frames = json.loads((folder / "dataset.json").read_text())["frames"]
    frames[3]["index"] = 2
    edit_index(folder, frames=frames)
    assert "(2)" in error_of(folder).cause


@pytest.mark.parametrize(
    "camera",
    [
        {},
        {"world_to_camera": [[1, 0], [0, 1]], "focal_px": [9, 9]},
        {"world_to_camera": np.diag([1.0, 1, -1, 1]).tolist(), "focal_px": [9, 9]},
        {"world_to_camera": np.eye(4).tolist(), "focal_px": [9, -9]},
    ],
    ids=["absent", "shape", "mirrored", "focal"],
)
def test_a_camera_that_is_none(folder, camera):
    edit_index(folder, camera=camera and {**camera, "principal_point_px": [1, 1]})
    assert "camera of frame 0" in error_of(folder).cause


def test_an_index_that_is_no_json(folder):
    (folder / "dataset.json").write_text("{")
    assert "cannot be read" in error_of(folder).cause


@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (Path.unlink, "00002.png"),
        (lambda path: path.write_bytes(b"GIF89a" + bytes(100)), "not a PNG"),
        (
            lambda path: cv2.imwrite(str(path), np.zeros((HEIGHT, WIDTH * 2, 4), np.uint8)),
            r"24 x 8.*12 x 8",
        ),
    ],
    ids=["missing", "no PNG", "another size"],
)
def test_an_image_that_cannot_be_used(folder, damage, cause):
    damage(folder / "images/00002.png")
    assert re.search(cause, error_of(folder).cause)


def test_a_truncated_image_is_found_when_loading(folder):
    path = folder / "images/00002.png"
    whole = path.read_bytes()
    for kept in (0, 5, 20, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:kept])
        assert "00002.png" in error_of(folder).cause


def test_a_damaged_image_is_found_when_it_is_decoded(folder):
    path = folder / "images/00002.png"
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 255
    path.write_bytes(damaged)
    dataset = load_dataset(folder)
    dataset.read_image(1)
    with pytest.raises(UserError, match=r"00002\.png is damaged"):
        dataset.read_image(2)


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        # BGR without alpha, as OpenCV stores
        (np.array([30, 20, 10], np.uint8), (10, 20, 30, 255)),
        (257 * np.array([30, 20, 10, 99], np.uint16), (10, 20, 30, 99)),
        (np.array(77, np.uint8), (77, 77, 77, 255)),
    ],
    ids=["opaque", "sixteen bits", "grey"],
)
def test_other_kinds_of_png_become_rgba(folder, stored, expected):
    picture = np.broadcast_to(stored, (HEIGHT, WIDTH, *stored.shape)).copy()
    cv2.imwrite(str(folder / "images/00001.png"), picture)
    assert tuple(load_dataset(folder).read_image(1)[2, 2]) == expected


def test_a_dataset_is_known_by_its_index_also_a_damaged_one(folder):
    pictures = folder.parent / "pictures"
    pictures.mkdir()
    (pictures / "0.png").touch()
    assert not is_dataset(pictures)
    assert not is_dataset(folder.parent / "nothing")
    assert is_dataset(folder)
    (folder / "dataset.json").write_text("{")
    assert is_dataset(folder)
