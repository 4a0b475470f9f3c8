"""The check: good data passes, each known mistake is named, and nothing else is."""

import json
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.data.check import check_dataset, quick_check, unreadable_report
from rgbavatar_ns.data.check.film import head_turns
from rgbavatar_ns.data.check.sample import take_sample
from rgbavatar_ns.data.check.silhouette import down_to_the_neck, silhouette_overlap
from rgbavatar_ns.data.check.timing import longest_run, offset_agreement
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA

from .talking_head import (
    FOCAL_PX,
    NUM_FRAMES,
    SIZE,
    offset_by,
    selected,
    talking_head,
    with_cameras,
    with_images,
)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> TrackedDataset:
    return talking_head(tmp_path_factory.mktemp("good") / "data")


def kinds(problems, severity="error") -> list[str]:
    return [problem.kind for problem in problems if problem.severity == severity]


def flip(*signs: float) -> torch.Tensor:
    return torch.diag(torch.tensor([*signs, 1.0]))


def test_good_data_has_no_problem(good, tmp_path):
    report = check_dataset(good, sheet=tmp_path / "sheet.png")
    assert report.problems == ()
    assert report.usable
    assert quick_check(good) == []
    assert (report.format, report.frames, report.train, report.test) == (
        "rgbavatar native", NUM_FRAMES, NUM_FRAMES - 4, 4,
    )  # fmt: skip
    assert (report.num_cameras, report.moving, report.size) == (1, False, (SIZE, SIZE))
    assert report.focal_px == (FOCAL_PX, FOCAL_PX)
    assert list(report.iou) == list(range(NUM_FRAMES))
    assert min(report.iou.values()) > 0.75


def test_what_nobody_filmed_is_told_and_is_no_misfit(good, tmp_path):
    """The lower half is beyond the film; were it background, the mesh would leave the matte."""

    def below(value):
        def change(image):
            image[SIZE // 2 :] = value
            return image

        return change

    report = check_dataset(with_images(good, tmp_path / "marked", below(UNFILMED_RGBA)))
    assert report.usable
    assert report.unfilmed == pytest.approx(1 / 2)
    covered = np.array(list(report.iou.values()))
    empty = check_dataset(with_images(good, tmp_path / "empty", below(0)))
    assert empty.unfilmed == 0
    assert covered.min() > 0.75
    assert (covered - np.array(list(empty.iou.values()))).min() > 0.05


OPENGL = flip(1, -1, -1)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda m: OPENGL @ m, "y and z flipped, as in OpenGL"),
        (lambda m: flip(-1, -1, 1) @ m, "x and y flipped, as in PyTorch3D"),
        (lambda m: flip(-1, 1, -1) @ m, "x and z flipped"),
        (lambda m: m.inverse() @ OPENGL, "flipped"),
        (lambda m: m @ OPENGL, "flipped"),
        (lambda m: OPENGL @ m.inverse() @ OPENGL, "world to camera where camera to world is meant"),
    ],
)
def test_flipped_axes_are_named(good, wrong, told):
    data = with_cameras(good, world_to_camera=wrong(good.cameras.world_to_camera))
    report = check_dataset(data, max_frames=8)
    assert kinds(report.problems) == ["axes"]
    assert told in report.problems[0].cause
    assert not report.usable
    assert kinds(quick_check(data)) == ["axes"]


@pytest.mark.parametrize("factor", [0.4, 0.7, 0.85, 1.3, 3.0])
def test_a_wrong_focal_length_is_named_with_the_one_that_fits(good, factor):
    data = with_cameras(good, focal_px=good.cameras.focal_px * factor)
    report = check_dataset(data, max_frames=8)
    hair_could_explain_it = factor == 0.85
    assert report.usable == hair_could_explain_it
    assert kinds(report.problems, "warning" if report.usable else "error") == ["focal length"]
    told = float(report.problems[0].cause.split("about ")[-1].split(" ")[0])
    # A coarse row of zooms is tried, and hair makes the person larger than the mesh.
    assert told == pytest.approx(FOCAL_PX, rel=0.12 if hair_could_explain_it else 0.2)
    assert kinds(quick_check(data)) == (["focal length"] if factor in (0.4, 3.0) else [])


def test_a_camera_that_moves_is_one_camera(good):
    moved = good.cameras.world_to_camera.clone()
    moved[:, 0, 3] += torch.linspace(0, 0.01, NUM_FRAMES)
    report = check_dataset(with_cameras(good, world_to_camera=moved), max_frames=4)
    assert (report.num_cameras, report.moving) == (1, True)


@pytest.mark.parametrize("shift", [(0.3, 0.0), (-0.2, 0.2)])
def test_a_wrong_principal_point_is_named(good, shift):
    moved = good.cameras.principal_point_px + SIZE * torch.tensor(shift)
    report = check_dataset(with_cameras(good, principal_point_px=moved), max_frames=8)
    assert kinds(report.problems) == ["principal point"]
    side = "left" if shift[0] > 0 else "right"
    assert f"further {side}" in report.problems[0].cause


@pytest.mark.parametrize("frames", [-2, -1, 1, 2])
def test_an_offset_of_frames_is_named(good, frames):
    """Image i shows what the parameters of frame i - frames of the wrong pairing say."""
    report = check_dataset(offset_by(good, frames), max_frames=8)
    assert kinds(report.problems) == ["frame offset"]
    expected = f"frame i {'-' if frames > 0 else '+'} {abs(frames)} say"
    assert expected in report.problems[0].cause
    assert quick_check(offset_by(good, frames)) == []


@pytest.mark.parametrize(
    ("change", "kind", "max_frames"),
    [
        (lambda image: image[:, ::-1], "mirrored", 36),
        (lambda image: image[::-1], "", 20),
        (lambda image: image * 0, "mattes", 4),
    ],
    ids=["mirrored", "upside down", "empty mattes"],
)
def test_turned_and_empty_images_are_refused(good, tmp_path, change, kind, max_frames):
    report = check_dataset(with_images(good, tmp_path / "x", change), max_frames)
    assert not report.usable
    assert not kind or kind in kinds(report.problems)


def test_data_that_projects_outside_is_refused_at_once(good):
    away = good.cameras.world_to_camera.clone()
    away[:, :2, 3] += torch.tensor([30.0, 40.0])
    problems = quick_check(with_cameras(good, world_to_camera=away))
    assert [problem.severity for problem in problems] == ["error"]
    error = problems[0].as_error()
    assert isinstance(error, UserError)
    assert error.cause == problems[0].cause


def test_single_frames_outside_are_a_warning_with_their_numbers(good):
    theta = good.theta.clone()
    theta[[7, 20], good.layout.slice("translation").start] += 2.0
    report = check_dataset(replace(good, theta=theta))
    assert report.usable
    found = {problem.kind: problem for problem in report.problems}
    assert found["outside"].frames == (7, 20)


def test_opaque_images_are_told_and_their_axes_still_checked(good, tmp_path):
    def opaque(image):
        return np.dstack([image[..., :3], np.full((SIZE, SIZE), 255, np.uint8)])

    data = with_images(good, tmp_path / "x", opaque)
    report = check_dataset(data)
    assert (report.usable, report.iou) == (True, {})
    assert [problem.kind for problem in report.problems] == ["mattes"]
    wrong = OPENGL @ data.cameras.world_to_camera
    assert kinds(quick_check(with_cameras(data, world_to_camera=wrong))) == ["axes"]


# The dataset's words


@pytest.mark.parametrize(
    ("told", "head", "severity"),
    [
        ("INSTA", "FLAME 2023", "error"),
        ("INSTA", "makehuman", "error"),
        ("metrical-tracker", "FLAME 2023 Open", "error"),
        ("VHAP", "FLAME 2020", "warning"),
        ("VHAP", "makehuman", "error"),
        ("INSTA", "FLAME 2020", None),
        ("INSTA", "FLAME 2020 female", None),
        ("VHAP", "FLAME 2023", None),
        ("something else", "FLAME 2017", None),
    ],
)
def test_another_version_of_flame_than_the_systems_is_named(good, told, head, severity):
    data = replace(good, source={"format": told}, arrays=replace(good.arrays, name=head))
    report = check_dataset(data, max_frames=2)
    found = [p for p in report.problems if p.kind == "FLAME version"]
    assert [problem.severity for problem in found] == ([severity] if severity else [])
    assert kinds(quick_check(data)) == (["FLAME version"] if severity == "error" else [])
    assert report.format == told


def test_a_version_that_the_user_names_is_only_a_warning(good):
    arrays = replace(good.arrays, name="FLAME 2023")
    source = {"format": "IMAvatar", "options": {"flame_version": "2023"}}
    data = replace(good, source=source, arrays=arrays)
    assert quick_check(data) == []
    assert "FLAME version" in kinds(check_dataset(data, max_frames=2).problems, "warning")


def test_odd_parameters_are_named_by_field_and_frame(good):
    theta = good.theta.clone()
    theta[[3, 5], 0] = 40.0
    theta[9, good.layout.slice("jaw")] = torch.tensor([4.0, 0.0, 0.0])
    report = check_dataset(replace(good, theta=theta), max_frames=8)
    found = {p.cause.split(" ")[0]: p.frames for p in report.problems if p.kind == "parameters"}
    assert found == {"expression": (3, 5), "jaw": (9,)}
    ranges = {r.name: (r.smallest, r.largest) for r in report.ranges}
    assert ranges["expression"] == (0.0, 40.0)


def test_theta_that_never_changes_is_refused(good):
    report = check_dataset(replace(good, theta=good.theta[:1].expand(NUM_FRAMES, -1)), max_frames=4)
    assert "parameters" in kinds(report.problems)
    assert "the same in all 36 frames" in report.problems[0].cause


def test_odd_cameras_are_named(good):
    matrices = good.cameras.world_to_camera.clone()
    matrices[:, :3, 3] *= 1000
    data = with_cameras(
        good,
        world_to_camera=matrices,
        focal_px=torch.full((NUM_FRAMES, 2), 8.0),
        principal_point_px=torch.full((NUM_FRAMES, 2), -5.0),
    )
    told = " ".join(p.cause for p in check_dataset(data, max_frames=2).problems)
    angle = math.degrees(2 * math.atan(SIZE / 16))
    assert f"an angle of view of {angle:.1f} to {angle:.1f} degrees" in told
    assert "principal point outside" in told
    assert "e+02 m from the head" in told


def test_an_image_that_cannot_be_decoded_is_a_problem_not_a_crash(good, tmp_path):
    data = with_images(good, tmp_path / "x", lambda image: image)
    path = data.image_paths[0]
    path.write_bytes(path.read_bytes()[:200])
    report = check_dataset(data, sheet=tmp_path / "sheet.png")
    assert kinds(report.problems) == ["unreadable"]
    assert path.name in report.problems[0].cause
    assert report.sheet is None


def test_refused_folders_still_tell_their_format(good, tmp_path):
    error = UserError("theta holds NaN.", "Track again.")
    assert unreadable_report(good.root, error).format == "rgbavatar native"
    assert unreadable_report(tmp_path, error).format == "unknown"
    assert not unreadable_report(tmp_path / "none", error).usable


# The report


def test_json_has_the_promised_keys_and_only_plain_values(good, tmp_path):
    values = check_dataset(offset_by(good, 1), 8, tmp_path / "sheet.png").to_json()
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert {"format", "frames", "usable", "problems"} <= set(values)
    assert (values["frames"], values["usable"]) == (NUM_FRAMES - 1, False)
    assert set(values["problems"][0]) == {"kind", "severity", "cause", "remedy", "frames"}


def test_sheet_shows_the_mesh_where_the_head_is(good, tmp_path):
    path = tmp_path / "new" / "sheet.png"
    check_dataset(good, max_frames=4, sheet=path)
    sheet = cv2.imread(str(path)).astype(int)
    assert sheet.shape == (320, 4 * 320, 3)
    first = cv2.resize(good.read_image(0), (320, 320))
    # Wires are bluer than red; picture and ground are grey.
    wires = sheet[:, :320, 0] - sheet[:, :320, 2] > 20
    inside = first[..., 3] > 128
    assert wires[inside].mean() > 0.2
    assert wires[~inside].mean() < 0.01


# Parts


def test_overlap_of_squares_worked_by_hand():
    mesh, matte = np.zeros((10, 10), np.float32), np.zeros((10, 10), np.float32)
    mesh[2:6, 2:6] = 1
    matte[4:10, 2:6] = 1
    found = silhouette_overlap(mesh, matte, down_to_the_neck(mesh))
    # 8 pixels in common; the matte below the mesh's last row does not count.
    assert found.iou == pytest.approx(8 / 16)
    assert found.covered == pytest.approx(8 / 16)
    assert silhouette_overlap(mesh * 0, matte, down_to_the_neck(mesh * 0)).iou == 0


def test_offset_agreement_is_one_at_the_true_offset():
    signal = np.random.default_rng(1).uniform(size=30)
    for offset in (-2, -1, 0, 1, 2):
        moved = np.roll(signal, offset)
        assert offset_agreement(moved, signal, offset) == pytest.approx(1)
        assert offset_agreement(moved, signal, offset + 1) < 0.6
    assert offset_agreement(np.ones(30), signal, 0) == 0


def test_longest_run_is_of_one_camera_without_gaps(good):
    numbers = (0, 1, 2, 5, 6, 7, 8, 20)
    assert longest_run(replace(selected(good, list(range(8))), frame_index=numbers)) == (3, 4, 5, 6)
    steps = (0, 0, 1, 1, 2, 2, 3, 3)
    few = replace(selected(good, list(range(8))), camera_names=("a", "b") * 4, timesteps=steps)
    assert longest_run(few) == (0, 2, 4, 6)
    assert longest_run(selected(good, [4])) == (0,)


def test_sample_keeps_size_and_place(good):
    sample = take_sample(good, [1, 4])
    assert sample.alpha.shape == (2, SIZE, SIZE)
    assert sample.scale == 1
    picked = sample.select([1])
    assert picked.positions == (4,)
    assert np.array_equal(picked.vertices[0], sample.vertices[1])


def test_one_frame_can_be_checked(good):
    single = selected(good, [0])
    assert quick_check(single) == []
    assert check_dataset(single).usable


@pytest.mark.parametrize("mover", ["head", "neck", "camera"])
def test_head_turns_are_what_the_camera_sees_whatever_moves(good, mover):
    yaw = torch.linspace(-20, 20, len(good)).deg2rad()
    turn = torch.zeros(len(good), 3)
    turn[:, 1] = yaw
    theta, cameras = torch.zeros_like(good.theta), good.cameras
    if mover == "camera":
        views = cameras.world_to_camera.clone()
        views[:, :3, :3] = views[:, :3, :3] @ axis_angle_to_matrix(turn)
        cameras = replace(cameras, world_to_camera=views)
    else:
        theta[:, good.layout.slice({"head": "rotation"}.get(mover, mover))] = turn
    seen = head_turns(replace(good, theta=theta, cameras=cameras))
    # Between the percentiles 2 and 98 of an even turn of 40 degrees.
    assert seen.left + seen.right == pytest.approx(0.96 * 40, abs=0.3)
    assert max(seen.up, seen.down) < 5, "where this camera stands, and no more"


@pytest.mark.parametrize(
    ("axis", "sign", "told"), [(1, 1, "left"), (1, -1, "right"), (0, -1, "up"), (0, 1, "down")]
)
def test_a_turn_is_told_by_the_side_that_the_face_goes_to(good, axis, sign, told):
    theta = torch.zeros_like(good.theta)
    first = good.layout.slice("rotation").start
    theta[:, first + axis] = sign * torch.linspace(0, 25, len(good)).deg2rad()
    # The face looks along the turned z axis: y up, +x the subject's left.
    ahead = axis_angle_to_matrix(theta[-1, first : first + 3])[:, 2]
    where = {"left": ahead[0], "right": -ahead[0], "up": ahead[1], "down": -ahead[1]}[told]
    assert where > 0.4
    views = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).expand(len(good), 4, 4)
    seen = vars(head_turns(with_cameras(replace(good, theta=theta), world_to_camera=views)))
    assert seen.pop(told) == pytest.approx(0.98 * 25, abs=0.3)
    assert max(seen.values()) < 1


def test_the_check_says_what_the_film_lacks(good):
    film = check_dataset(good).film
    assert film is not None
    assert film.frames == len(good)
    lacking = check_dataset(good).to_json()["film"]["lacks"]
    assert any(what.startswith("length") for what in lacking)
    assert film.face_height_px is None, "only the tracker has seen the film itself"
    assert not any("face" in what for what in lacking)
