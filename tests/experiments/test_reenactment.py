"""AED, APD and CSIM against trackers and networks whose answer is known."""

from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import cells_of, read_experiment, reenactment, runner
from rgbavatar_ns.experiments.cell_pictures import read_pictures
from rgbavatar_ns.experiments.reenactment import (
    OnnxFaceRecognition,
    aligned_face,
    identity_similarity,
    load_tracker,
    reenactment_scores,
    tracked_distances,
)
from rgbavatar_ns.experiments.runner import write_cell
from rgbavatar_ns.experiments.seen_pose import eyes_px
from rgbavatar_ns.experiments.sweep import CellStatus, check_experiment
from rgbavatar_ns.experiments.tables import result_table
from rgbavatar_ns.head import HeadModel, ThetaLayout
from rgbavatar_ns.head.layout import ThetaField
from tests.plugin.run import SMALL
from tests.plugin.tiny import NUM_TEST, tiny_dataset

# One GlobalAveragePool: the mean of each channel, [1, 3, 112, 112] to [1, 3, 1, 1].
MEAN_NETWORK = Path(__file__).with_name("mean.onnx")


class Ruler:
    """Reads theta off the first pixels of a picture; no face in a black one."""

    layout = ThetaLayout(
        (
            ThetaField("expression", 2, "linear"),
            ThetaField("neck", 3, "axis_angle"),
            ThetaField("left_eye", 3, "axis_angle"),
            ThetaField("translation", 3, "translation"),
        )
    )

    def __call__(self, picture_rgb):
        row = torch.from_numpy(picture_rgb[0, :11, 0].astype(np.float32))
        return row / 100 if row.any() else None


def ruler():
    return Ruler()


def no_tracker():
    return 3


def _picture(*values):
    picture = np.zeros((4, 16, 3), np.uint8)
    picture[0, : len(values), 0] = values
    return picture


def test_distances_are_those_of_expression_and_of_rotations_but_the_eyes():
    # Expression differs by (.3, .4), the neck by (.2, 0, 0); eyes and translation do not count.
    first = (_picture(30, 40, 20, 0, 0, 90, 0, 0, 70), _picture(60, 80, 40, 0, 0, 10, 0, 0, 10))
    same = (_picture(5, 5, 5), _picture(5, 5, 5))
    lost = (_picture(), _picture(99, 99))
    scores = tracked_distances([first, same, lost], Ruler())
    assert scores == {"aed": pytest.approx(0.25), "apd": pytest.approx(0.1)}
    assert tracked_distances([lost], Ruler()) == {}


def test_similarity_is_the_cosine_to_the_persons_mean():
    vectors = {1: np.array([1.0, 0.0]), 2: np.array([0.0, 1.0]), 3: np.array([-0.6, 0.8])}

    def recognise(face):
        return vectors[int(face[0, 0, 0])]

    one, two, three = (np.full((112, 112, 3), n, np.uint8) for n in (1, 2, 3))
    assert identity_similarity([one], [one, two], recognise) == pytest.approx(0.5)
    assert identity_similarity([one, two], [one], recognise) == pytest.approx(0.5**0.5)
    assert identity_similarity([one], [three], recognise) == pytest.approx(-0.6)


def test_alignment_puts_the_eyes_into_their_places():
    picture = np.zeros((200, 200, 3), np.uint8)
    eyes = np.array([[90.0, 120.0], [110.0, 100.0]])  # tilted, and smaller
    for column, row in eyes.astype(int):
        picture[row - 2 : row + 3, column - 2 : column + 3] = 255
    face = aligned_face(picture, eyes)
    assert face.shape == (112, 112, 3)
    assert face[52, 38].min() > 200
    assert face[52, 74].min() > 200
    assert face[52, 56].max() == 0


def test_eyes_are_found_where_the_head_has_them(tmp_path):
    data = tiny_dataset(tmp_path / "data", size=64, frames=4, test=1)
    head = HeadModel(data.arrays)
    rest = torch.zeros(1, data.layout.size)
    camera = data.cameras.select([0])
    left, right = head.joints(data.identity)[3], head.joints(data.identity)[4]
    right_px, left_px = eyes_px(head, data.identity, rest, camera)[0]
    # At rest the joints themselves: projected by hand, with the first pixel's centre at 0.
    for joint, pixel in ((right, right_px), (left, left_px)):
        seen = camera.world_to_camera[0, :3, :3] @ joint + camera.world_to_camera[0, :3, 3]
        expected = seen[:2] / seen[2] * camera.focal_px[0] + camera.principal_point_px[0] - 0.5
        assert pixel == pytest.approx(expected.numpy(), abs=1e-3)
    assert right_px[0] < left_px[0]


def test_a_network_of_a_file_sees_rgb_around_zero():
    recognise = OnnxFaceRecognition(MEAN_NETWORK)
    face = np.zeros((112, 112, 3), np.uint8)
    face[..., 0] = 255
    # Red 1, green and blue -1, brought to unit length.
    assert recognise(face) == pytest.approx(np.array([1, -1, -1]) / 3**0.5, abs=1e-5)


def test_a_file_that_is_no_network_is_refused(tmp_path):
    (tmp_path / "no.onnx").write_text("not a network")
    with pytest.raises(UserError, match="cannot be read as a face-recognition network"):
        OnnxFaceRecognition(tmp_path / "no.onnx")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("no_such_module:ruler", "cannot be had"),
        (f"{__name__}:rule", "cannot be had"),
        (f"{__name__}", "cannot be had"),
        (f"{__name__}:no_tracker", "no tracker of pictures"),
    ],
)
def test_what_is_no_tracker_is_refused(name, told):
    with pytest.raises(UserError, match=told):
        load_tracker(name)


class _Anywhere(Ruler):
    def __call__(self, picture_rgb):
        mean = float(picture_rgb.mean()) / 255
        return torch.full((11,), mean)


def test_an_avatar_is_scored_on_its_drivers_held_out_frames(tmp_path, monkeypatch):
    own = tiny_dataset(tmp_path / "own")
    driver = tiny_dataset(tmp_path / "driver", frames=9)
    avatar = Avatar(HeadModel(own.arrays), own.identity, SMALL)
    seen = []

    def count(pairs, tracker):
        seen.extend(pairs)
        return tracked_distances(seen, tracker)

    monkeypatch.setattr(reenactment, "tracked_distances", count)
    recognise = OnnxFaceRecognition(MEAN_NETWORK)
    values, missing = reenactment_scores(avatar, own, driver, _Anywhere(), recognise)
    assert len(seen) == NUM_TEST
    assert set(values) == {"aed", "apd", "csim"}
    assert values["aed"] > 0
    assert -1 <= values["csim"] <= 1
    assert not missing
    values, missing = reenactment_scores(avatar, own, driver, None, None)
    assert not values
    assert missing["csim"] == "no face-recognition file was named"
    assert missing["aed"] == missing["apd"] == "no tracker was named"


TEXT = """
title: Across
preset: rgbavatar-tiny
subjects: [own]
metrics: [psnr, aed, apd, csim]
cross_identity: {driver: driver, tracker: "%s:ruler"}
variants: [{name: Ours, paper: {aed: 9.2683, apd: 0.1179, csim: 0.7868}}]
"""


def _experiment(tmp_path, text):
    for name in ("own", "driver"):
        (tmp_path / name).mkdir(exist_ok=True)
    (tmp_path / "across.yaml").write_text(text)
    return read_experiment(tmp_path / "across.yaml")


def test_the_runner_scores_and_the_table_says_what_is_not_available(tmp_path, monkeypatch):
    experiment = _experiment(tmp_path, TEXT % __name__)
    check_experiment(experiment)
    (cell,) = cells_of(experiment)
    assert cell.cross_identity is not None
    assert cell.cross_identity["driver"] == str(tmp_path / "driver")
    write_cell(tmp_path, cell, tmp_path / "own", tmp_path / "driver", side_by_side=True)
    run = tmp_path / "run/cell/rgbavatar-tiny/run"
    run.mkdir(parents=True)
    (run / "training.json").write_text('{"steps": 1}')
    (tmp_path / "eval.json").write_text('{"results": {"psnr": 30.0}}')
    monkeypatch.setattr(runner.commands, "run_nerfstudio", lambda *command: None)
    tiny_dataset(tmp_path / "own")
    tiny_dataset(tmp_path / "driver")
    own = runner.load_dataset(tmp_path / "own")
    avatar = Avatar(HeadModel(own.arrays), own.identity, SMALL)
    monkeypatch.setattr(runner, "load_avatar", lambda path: avatar)
    monkeypatch.setattr(Ruler, "__call__", _Anywhere.__call__)
    result = runner.run_cell(tmp_path)
    assert {"psnr", "aed", "apd", "frames_per_second", "megabytes"} <= set(result["metrics"])
    assert result["metrics"]["gaussians"] == avatar.num_gaussians
    assert result["made"]["cores"] >= 1
    assert result["made"]["side_by_side"] is True
    assert len(read_pictures(tmp_path)) == 3
    assert result["unavailable"] == {"csim": "no face-recognition file was named"}
    status = CellStatus(cell, tmp_path, "done", result)
    table = result_table(experiment, [status]).to_markdown()
    assert "CSIM is not available: no face-recognition file was named" in table
    assert "9.2683" in table


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("driver: driver,", "driver: away,", "does not exist"),
        ("driver: driver,", "drivr: driver,", "Did you mean 'driver'"),
        ("driver: driver,", "", "Give texts, with a `driver`"),
        ("tracker:", "face_recognition: no.onnx, tracker:", "which does not exist"),
        (":ruler", ":rules", "cannot be had"),
        ("cross_identity: {driver", "base: {} # {driver", "Name a driver"),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, told):
    text = TEXT % __name__
    assert old in text

    def read_and_check():
        experiment = _experiment(tmp_path, text.replace(old, new))
        check_experiment(experiment)
        cells_of(experiment)

    with pytest.raises(UserError) as refused:
        read_and_check()
    assert told in str(refused.value)
