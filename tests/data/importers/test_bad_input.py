"""Whatever one file's damage is: a clear error or the very same import, never another one."""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rgbavatar_ns.data.check import unreadable_report
from rgbavatar_ns.data.importers import ImportOptions, Source, read_source
from rgbavatar_ns.data.importers.frame_images import (
    make_png,
)
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.png import decode_png_rgba
from rgbavatar_ns.errors import UserError
from tests.data.importers.takes import FIRST, HEIGHT, NUM_FRAMES, WIDTH
from tests.data.importers.test_round_trips import FORMATS, write

MATRIX = [[1.0, 2.0], [3.0, 4.0]]  # a list of one number may be all that is known of a shape
BAD_VALUES = (float("nan"), float("inf"), None, "text", [], {}, MATRIX, True, 10**400, -1e300)
ODD_NAMES = ("日本語 ", "ü ñ", "two words", "%s{}")


@pytest.fixture(scope="session")
def folders(tmp_path_factory, takes) -> dict[str, Path]:
    made = {}
    for name in FORMATS:
        made[name] = tmp_path_factory.mktemp("formats") / name
        write(made[name], name, takes)
    return made


@pytest.fixture(scope="session")
def references(folders, flame_folder) -> dict[str, Source]:
    return {name: read(folder, flame_folder) for name, folder in folders.items()}


def read(folder: Path, flame: Path, **options) -> Source:
    options = ImportOptions(flame=flame, teeth=False, **options)
    source = read_source(folder, options)
    size = (source.cameras.width, source.cameras.height)
    try:
        for frame_image in source.frame_images:
            make_png(frame_image, size)
    except UnusableFrameError as error:
        raise UserError(str(error), "") from None
    return source


def assert_same(one: Source, other: Source, positions: list[int] | None = None) -> None:
    kept = list(range(len(other))) if positions is None else positions
    assert one.index == tuple(other.index[k] for k in kept)
    assert torch.allclose(one.theta, other.theta[kept], atol=1e-4)
    assert torch.allclose(one.identity, other.identity, atol=1e-4)
    for part in ("world_to_camera", "focal_px", "principal_point_px"):
        theirs = getattr(other.cameras, part)[kept]
        assert torch.allclose(getattr(one.cameras, part), theirs, atol=1e-4)
    size = (one.cameras.width, one.cameras.height)
    for mine, k in zip(one.frame_images, kept):
        png, wanted = make_png(mine, size).encoded, make_png(other.frame_images[k], size).encoded
        assert np.array_equal(decode_png_rgba(png, ""), decode_png_rgba(wanted, ""))


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@st.composite
def damages(draw: st.DrawFn):
    """A function of a folder and something beside it, which damages the folder."""
    kind = draw(st.sampled_from(["delete", "cut", "empty", "garbage", "link", "json", "json"]))
    which, share = draw(st.integers(0, 10**6)), draw(st.floats(0, 0.999))
    key, value = draw(st.integers(0, 10**6)), draw(st.sampled_from(BAD_VALUES))
    remove = draw(st.booleans())

    def damage(folder: Path, beside: Path) -> None:
        files = files_of(folder)
        if kind == "json":
            files = [path for path in files if path.suffix == ".json"] or files
        path = files[which % len(files)]
        if kind == "json" and path.suffix == ".json":
            damage_json(path, key, None if remove else (value,))
        elif kind == "cut":
            content = path.read_bytes()
            path.write_bytes(content[: int(share * len(content))])
        elif kind == "link":
            shutil.move(path, beside / path.name)
            path.symlink_to(beside / path.name)
        elif kind in ("empty", "garbage"):
            path.write_bytes(b"" if kind == "empty" else os.urandom(4000))
        else:
            path.unlink()

    return damage


def damage_json(path: Path, key: int, value: tuple | None) -> None:
    """Remove an entry, of a frame or above all frames, or set it to something else."""
    content = json.loads(path.read_text())
    frames = content["frames"]
    place = key % (len(frames) + 1)
    target = content if place == len(frames) else frames[place]
    name = sorted(target)[key // (len(frames) + 1) % len(target)]
    if value is None:
        del target[name]
    else:
        target[name] = value[0]
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.nightly) if n == "insta-meshes" else n for n in FORMATS],
)
@settings(
    deadline=None,
    max_examples=10,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(damage=damages())
def test_a_damaged_folder_is_refused_or_read_the_same(
    name, damage, folders, references, flame_folder, tmp_path_factory
):
    place = tmp_path_factory.mktemp("damaged")
    folder = shutil.copytree(folders[name], place / name)
    (place / "beside").mkdir()
    damage(folder, place / "beside")
    try:
        source = read(folder, flame_folder)
    except UserError:
        pass
    else:
        assert_same(source, references[name])
        assert source.test == references[name].test
    finally:
        shutil.rmtree(place)


@pytest.mark.parametrize("key", ["fl_x", "fl_y", "cx", "cy"])
def test_a_list_in_place_of_a_cameras_number_is_refused(key, folders, flame_folder, tmp_path):
    folder = shutil.copytree(folders["insta"], tmp_path / "insta")
    for path in folder.glob("*.json"):
        content = json.loads(path.read_text())
        for values in (content, *content["frames"]):
            if key in values:
                values[key] = [[values[key]]]
        path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=f"{key} that is no single number"):
        read(folder, flame_folder)


@pytest.mark.parametrize("name", ["metrical", "vhap", "imavatar", "flashavatar"])
def test_with_consent_the_other_frames_are_read_and_the_loss_is_told(
    name, folders, flame_folder, tmp_path
):
    folder = shutil.copytree(folders[name], tmp_path / name)
    images = {"metrical": "input", "vhap": "images", "imavatar": "image", "flashavatar": "imgs"}
    first, second, *_ = files_of(folder / images[name])
    first.unlink()
    cv2.imwrite(str(second), np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    with pytest.raises(UserError, match=r"cannot be used.*: 1 \(.*: 1 \(") as caught:
        read(folder, flame_folder)
    assert "--allow-partial" in caught.value.remedy
    assert f"{WIDTH + 1} x {HEIGHT}" in caught.value.cause
    # As the format has it: else the first frame that is left decides where the head stands.
    source = read(folder, flame_folder, allow_partial=True, head_pose="source")
    whole = read(folders[name], flame_folder, head_pose="source")
    assert_same(source, whole, list(range(2, NUM_FRAMES)))
    assert any("left out" in note for note in source.notes)


@pytest.mark.parametrize("odd", ODD_NAMES)
def test_folders_of_any_name_are_read(odd, folders, references, flame_folder, tmp_path):
    for name in ("imavatar", "flashavatar"):
        folder = shutil.copytree(folders[name], tmp_path / odd / name)
        assert_same(read(folder, flame_folder), references[name])


def test_a_link_out_of_the_folder_needs_consent(folders, references, flame_folder, tmp_path):
    folder = shutil.copytree(folders["metrical"], tmp_path / "data")
    shutil.move(folder / "input", tmp_path / "elsewhere")
    (folder / "input").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="leads out") as caught:
        read(folder, flame_folder)
    assert "--allow-outside" in caught.value.remedy
    assert_same(read(folder, flame_folder, allow_outside=True), references["metrical"])


def test_another_version_of_flame_is_refused_with_the_reason(folders, flame_folder):
    for name, other in (("imavatar", "2023"), ("vhap", "2020")):
        pickle = next((flame_folder / f"FLAME{other}").glob("*.pkl"))
        with pytest.raises(UserError, match=f"but .* is FLAME {other}") as caught:
            read(folders[name], pickle)
        assert "--flame-version" in caught.value.remedy
        report = unreadable_report(folders[name], caught.value)
        assert [problem.kind for problem in report.problems] == ["FLAME version"]


def test_the_flag_does_not_make_another_version_of_a_pickle_whose_name_says_it(
    folders, references, flame_folder, tmp_path
):
    pickles = {year: next((flame_folder / f"FLAME{year}").glob("*.pkl")) for year in (2020, 2023)}
    with pytest.raises(UserError, match="is FLAME 2020 by its name") as caught:
        read(folders["vhap"], pickles[2020], flame_version="2023")
    assert "--flame-version '2020'" in caught.value.remedy
    assert_same(read(folders["vhap"], pickles[2023], flame_version="2023"), references["vhap"])
    nameless = tmp_path / "model.pkl"
    nameless.symlink_to(pickles[2023])
    beside = {"flame_uv": pickles[2023].parent / "head_template.obj"}
    beside["flame_eyelids"] = pickles[2023].parent
    source = read(folders["vhap"], nameless, flame_version="2023", **beside)
    assert_same(source, references["vhap"])


def test_fifty_expressions_are_padded_within_a_version(folders, references, flame_folder, tmp_path):
    folder = shutil.copytree(folders["imavatar"], tmp_path / "data")
    path = folder / "flame_params.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        frame["expression"] = frame["expression"][:50]
    path.write_text(json.dumps(content))
    wanted = references["imavatar"].theta.clone()
    wanted[:, 50:100] = 0
    assert torch.allclose(read(folder, flame_folder).theta, wanted)
    content["frames"][1]["expression"] = content["frames"][1]["expression"][:40]
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match="40, 50 numbers"):
        read(folder, flame_folder)


def test_many_cameras_and_the_held_out_one(folders, references, flame_folder, tmp_path):
    folder = shutil.copytree(folders["vhap"], tmp_path / "data")
    content = json.loads((folder / "transforms.json").read_text())
    both = []
    for frame in content["frames"]:
        for camera in (3, 8):
            moved = np.array(frame["transform_matrix"])
            moved[0, 3] += 0.01 * camera
            own = {"camera_index": camera, "camera_id": f"cam{camera}"}
            own["file_path"] = f"images/{camera}/{frame['timestep_id']}.png"
            own["transform_matrix"] = moved.tolist()
            target = folder / own["file_path"]
            target.parent.mkdir(exist_ok=True)
            shutil.copy(folder / frame["file_path"], target)
            both.append({**frame, **own})
    late = [frame for frame in both if frame["timestep_index"] >= FIRST + 4]
    early = [frame for frame in both if frame not in late]
    splits = {
        "": both,
        "_train": [frame for frame in early if frame["camera_index"] != 8],
        "_val": [frame for frame in early if frame["camera_index"] == 8],
        "_test": late,
    }
    for split, frames in splits.items():
        (folder / f"transforms{split}.json").write_text(json.dumps({"frames": frames}))
    for path in files_of(folder / "images"):
        if path.parent.name == "images":
            path.unlink()
    source = read(folder, flame_folder)
    assert source.camera_names == ("cam3", "cam8") * NUM_FRAMES
    assert source.timesteps == tuple(FIRST + k // 2 for k in range(2 * NUM_FRAMES))
    train = [k for k, number in enumerate(source.index) if number not in source.test]
    assert {(source.camera_names[k], source.timesteps[k]) for k in train} == {
        ("cam3", FIRST + k) for k in range(4)
    }
    reference = references["vhap"]
    assert torch.equal(source.theta[::2], reference.theta)
    shift = source.cameras.world_to_camera[:, :3, 3] - torch.repeat_interleave(
        reference.cameras.world_to_camera[:, :3, 3], 2, 0
    )
    assert torch.allclose(shift[:, 0], torch.tensor([-0.03, -0.08] * NUM_FRAMES), atol=1e-6)
    held_out = read(folder, flame_folder, test_cameras=("cam3",))
    assert held_out.test == frozenset(source.index[::2])


def test_what_no_person_can_do_is_left_out_with_the_reason(folders, flame_folder, tmp_path):
    folder = shutil.copytree(folders["imavatar"], tmp_path / "data")
    path = folder / "flame_params.json"
    content = json.loads(path.read_text())
    content["frames"][1]["expression"][7] = 100_000
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"no person can do \(expression reaches 100000"):
        read(folder, flame_folder)
    source = read(folder, flame_folder, allow_partial=True)
    assert len(source) == NUM_FRAMES - 1
    content["frames"][1]["expression"][7] = True
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match="expression that is no list of numbers"):
        read(folder, flame_folder)


def test_nothing_known_says_what_lies_below(folders, tmp_path):
    shutil.copytree(folders["imavatar"], tmp_path / "subject")
    with pytest.raises(UserError, match="Its folders subject are known"):
        read_source(tmp_path, ImportOptions())
    with pytest.raises(UserError, match="no format 'x'"):
        read_source(tmp_path, ImportOptions(format="x"))
