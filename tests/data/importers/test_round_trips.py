"""What is written as another system's data comes back: images, cameras and vertices."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import TrackedDataset, load_dataset
from rgbavatar_ns.data.importers import ImportOptions, Source, import_dataset, read_source
from rgbavatar_ns.data.importers.frame_images import FrameImage
from rgbavatar_ns.data.importers.frame_record import CameraRecord, FrameRecord
from rgbavatar_ns.data.importers.head_pose import place_head_pose
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.synthetic.exporters import Take, TakeFrame
from rgbavatar_ns.synthetic.exporters.folders import (
    FlashAvatarWriter,
    IMAvatarWriter,
    InstaWriter,
    MetricalWriter,
    VhapWriter,
)
from tests.data.importers.takes import FIRST, NUM_FRAMES, NUM_TEST

FORMATS = {
    "insta": (InstaWriter, "2020", True, "INSTA"),
    "insta-meshes": (InstaWriter, "2020", True, "INSTA"),
    "metrical": (MetricalWriter, "2020", True, "metrical-tracker"),
    "vhap": (VhapWriter, "2023", False, "VHAP"),
    "flashavatar": (FlashAvatarWriter, "2020", True, "FlashAvatar"),
    "imavatar": (IMAvatarWriter, "2020", False, "IMAvatar"),
}
HEAD_SIZE_M = 0.3
SPLIT_FILES = ("insta", "insta-meshes", "vhap")

Takes = Callable[[str, bool], tuple[Take, list[TakeFrame]]]


def write(folder: Path, name: str, takes: Takes) -> tuple[Take, list[TakeFrame]]:
    make, version, stiff_neck, _ = FORMATS[name]
    take, frames = takes(version, stiff_neck)
    take = replace(take, name=folder.name)
    writer = make(folder, take)
    for frame in frames:
        writer.add(frame)
    writer.finish()
    if name == "insta-meshes":
        shutil.rmtree(folder / "checkpoint")
    return take, frames


def seen(take: Take, frame: TakeFrame) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in the camera's axes and their pixels, from what was written, in float64."""
    head = HeadModel(take.arrays, torch.float64)
    theta = head.layout.join({name: torch.from_numpy(part) for name, part in frame.theta.items()})
    vertices = head(theta, torch.from_numpy(take.identity)).numpy()
    matrix = frame.camera.world_to_camera[0].double().numpy()
    points = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    focal, centre = frame.camera.focal_px[0].numpy(), frame.camera.principal_point_px[0].numpy()
    return points, points[:, :2] / points[:, 2:] * focal + centre


def seen_in(dataset: TrackedDataset | Source, position: int) -> tuple[np.ndarray, np.ndarray]:
    """The same of a dataset, as training computes it."""
    vertices = HeadModel(dataset.arrays)(dataset.theta[position], dataset.identity).numpy()
    cameras = dataset.cameras
    matrix = cameras.world_to_camera[position].numpy()
    points = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    focal, centre = cameras.focal_px[position].numpy(), cameras.principal_point_px[position].numpy()
    return points, points[:, :2] / points[:, 2:] * focal + centre


def assert_same_views(
    take: Take, frames: list[TakeFrame], dataset: TrackedDataset | Source
) -> None:
    numbers = dataset.index if isinstance(dataset, Source) else dataset.frame_index
    assert numbers == tuple(frame.index for frame in frames)
    own = len(take.arrays.v_template)
    for position, frame in enumerate(frames):
        points, pixels = seen(take, frame)
        points_in, pixels_in = seen_in(dataset, position)
        assert np.abs(points_in[:own] - points).max() < 1e-4 * HEAD_SIZE_M
        assert np.abs(pixels_in[:own] - pixels).max() < 0.05


@pytest.mark.parametrize("name", FORMATS)
def test_a_round_trip_gives_the_same_images_cameras_and_vertices(
    name, tmp_path, takes, flame_folder
):
    take, frames = write(tmp_path / "data", name, takes)
    options = ImportOptions(flame=flame_folder, teeth=False)
    dataset = import_dataset(tmp_path / "data", tmp_path / "native", options)
    assert dataset.source["format"] == FORMATS[name][3]
    assert_same_views(take, frames, dataset)
    for position, frame in enumerate(frames):
        off = np.abs(dataset.read_image(position).astype(int) - frame.image_rgba)
        if name == "flashavatar":  # JPEG
            assert off[..., 3].max() <= 3
            assert off.mean() < 2
        elif name == "vhap":  # over white, where fractions of a level are cut off
            assert off[..., 3].max() == 0
            alpha = frame.image_rgba[..., 3:]
            assert (off[..., :3] * (alpha / 255.0)).max() < 2
        else:
            assert off.max() == 0
    held_out = NUM_TEST if name in SPLIT_FILES else NUM_FRAMES // 4
    assert [dataset.frame_index[k] for k in dataset.test] == [
        FIRST + NUM_FRAMES - held_out + k for k in range(held_out)
    ]


@pytest.mark.parametrize("name", ["metrical", "vhap", "imavatar"])
@pytest.mark.parametrize("head_pose", ["camera", "head"])
def test_the_heads_motion_may_be_the_cameras_or_the_heads(
    name, head_pose, tmp_path, takes, flame_folder
):
    take, frames = write(tmp_path / "data", name, takes)
    options = ImportOptions(flame=flame_folder, teeth=False, head_pose=head_pose)
    dataset = read_source(tmp_path / "data", options)
    assert_same_views(take, frames, dataset)
    parts = dataset.layout.split(dataset.theta)
    if head_pose == "camera":
        assert not parts["rotation"].any()
        assert not parts["translation"].any()
    else:
        assert (dataset.cameras.world_to_camera == dataset.cameras.world_to_camera[:1]).all()


@pytest.mark.parametrize(
    ("name", "moved"), [("insta-meshes", True), ("metrical", True), ("vhap", False)]
)
def test_by_default_a_head_that_the_camera_moves_about_moves_itself(
    name, moved, tmp_path, takes, flame_folder
):
    take, frames = write(tmp_path / "data", name, takes)
    dataset = read_source(tmp_path / "data", ImportOptions(flame=flame_folder, teeth=False))
    assert_same_views(take, frames, dataset)
    assert any("still head" in note for note in dataset.notes) == moved
    assert (dataset.cameras.world_to_camera == dataset.cameras.world_to_camera[:1]).all()
    rotation = dataset.layout.split(dataset.theta)["rotation"]
    wanted = np.stack([frame.theta["rotation"] for frame in frames])
    if moved:
        turns = [axis_angle_to_matrix(torch.from_numpy(turn)) for turn in wanted]
        relative = torch.stack([turns[0].T @ turn for turn in turns])
        assert torch.allclose(axis_angle_to_matrix(rotation.double()), relative, atol=1e-5)
    else:
        assert np.allclose(rotation, wanted, atol=1e-6)


def test_on_the_neck_the_head_stays_and_the_collar_does_not_turn(takes):
    take, frames = takes("2023", False)
    weights = np.zeros_like(take.arrays.skinning_weights)
    weights[:, 1] = 1
    collar = np.arange(50)
    weights[collar] = [1, 0, 0, 0, 0]
    arrays = replace(take.arrays, skinning_weights=weights)
    records = [
        FrameRecord(
            frame.index,
            FrameImage(Path("none.png")),
            {name: part for name, part in frame.theta.items() if name != "eyelids"},
            CameraRecord(frame.camera.world_to_camera[0].double().numpy(), np.ones(2), np.zeros(2)),
        )
        for frame in frames
    ]
    placed = place_head_pose(records, arrays, take.identity, "neck")
    first = placed[0].camera.world_to_camera
    head = HeadModel(arrays, torch.float64)

    def posed(record: FrameRecord, **changed: np.ndarray) -> np.ndarray:
        parts = {**record.theta, **changed}
        theta = head.layout.join({name: torch.from_numpy(part) for name, part in parts.items()})
        return head(theta, torch.from_numpy(take.identity)).numpy()

    for before, after in zip(records, placed):
        assert np.array_equal(after.camera.world_to_camera, first)
        old, new = posed(before), posed(after)
        assert np.abs(old[50:] - new[50:]).max() < 1e-9
        unturned = posed(after, neck=np.zeros(3), translation=np.zeros(3))
        moved = new[collar] - unturned[collar]
        assert np.abs(moved - after.theta["translation"]).max() < 1e-9
        assert np.abs(old[collar] - new[collar]).max() > 1e-3


def test_a_folder_of_another_system_opens_directly_and_the_second_time_as_our_own(
    tmp_path, takes, flame_folder, monkeypatch, capsys
):
    take, frames = write(tmp_path / "data", "imavatar", takes)
    monkeypatch.setenv("RGBAVATAR_FLAME", str(flame_folder))
    options = ImportOptions(teeth=False)
    dataset = load_dataset(tmp_path / "data", options)
    assert_same_views(take, frames, dataset)
    told = capsys.readouterr().err
    assert "IMAvatar data in" in told
    assert ".rgbavatar" in str(dataset.root)

    def refuse(*_, **__):
        raise AssertionError("read again")

    monkeypatch.setattr("rgbavatar_ns.data.importers.convert.read_source", refuse)
    again = load_dataset(tmp_path / "data", options)
    assert again.root == dataset.root
    assert torch.equal(again.theta, dataset.theta)
    monkeypatch.delenv("RGBAVATAR_FLAME")
    assert load_dataset(tmp_path / "data", options).root == dataset.root
    monkeypatch.setenv("RGBAVATAR_FLAME", str(flame_folder))
    with pytest.raises(AssertionError, match="read again"):
        load_dataset(tmp_path / "data", ImportOptions(teeth=True))
    image = tmp_path / "data/image" / f"{FIRST:05d}.png"
    image.write_bytes(image.read_bytes() + b"\0")
    with pytest.raises(AssertionError, match="read again"):
        load_dataset(tmp_path / "data", options)


@pytest.mark.nightly
def test_the_demo_subject_itself_comes_back(tmp_path):
    from rgbavatar_ns.synthetic import DemoConfig, film_demo
    from rgbavatar_ns.synthetic.exporters import FLAME_FOLDER, write_demo

    config = DemoConfig(image_size=32, num_frames=2, num_test_frames=1, supersampling=1)
    write_demo(tmp_path / "data", "insta", config)
    options = ImportOptions(flame=tmp_path / "data" / FLAME_FOLDER)
    dataset = load_dataset(tmp_path / "data", options)
    film = film_demo(config, stiff_neck=True)
    head, embedded = HeadModel(dataset.arrays), film.person.head
    for position, frame in enumerate(film.frames()):
        assert np.array_equal(dataset.read_image(position), frame.image_rgba)
        vertices = embedded(frame.theta, film.person.identity).numpy()
        matrix = frame.camera.world_to_camera[0].numpy()
        wanted = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        points, _ = seen_in(dataset, position)
        # The same vertices in other numbering: each has one of the subject's in its place.
        skin = points[:5023]
        nearest = np.sqrt(((skin[::50, None] - wanted[None]) ** 2).sum(-1)).min(1)
        assert nearest.max() < 1e-4 * HEAD_SIZE_M
    assert head.layout == dataset.layout
