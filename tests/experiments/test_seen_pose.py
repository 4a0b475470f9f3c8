"""A perfect copy scores 0, wherever data keep the head's pose, whatever it counts from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.data import DatasetWriter, TrackedDataset, TrackedFrame
from rgbavatar_ns.data.importers.frame_images import FrameImage
from rgbavatar_ns.data.importers.frame_record import CameraRecord, FrameRecord
from rgbavatar_ns.data.importers.head_pose import place_head_pose
from rgbavatar_ns.driving import DrivingOptions
from rgbavatar_ns.experiments import seen_pose
from rgbavatar_ns.experiments.reenactment import reenactment_scores, tracked_distances
from rgbavatar_ns.export import pictures, statistics_of
from rgbavatar_ns.export.scenes import driven_by
from rgbavatar_ns.head import HeadModel, ThetaLayout, turn_seen
from rgbavatar_ns.head.layout import ThetaField
from rgbavatar_ns.kernels import PinholeCameras
from tests.plugin.run import SMALL

SIZE, FRAMES, TEST = 48, 6, 3
BLACK = (0.0, 0.0, 0.0)
LIMIT = 1e-4
"""Of rounding to 8 bits."""


class Moments:
    """Sees where a picture is bright: a picture's own numbers, the same for equal pictures."""

    layout = ThetaLayout(
        (
            ThetaField("expression", 2, "linear"),
            ThetaField("neck", 3, "axis_angle"),
            ThetaField("translation", 3, "translation"),
        )
    )

    def __call__(self, picture_rgb):
        light = picture_rgb.astype(np.float64).sum(-1) / 765
        rows, columns = np.mgrid[: light.shape[0], : light.shape[1]] / len(light) - 0.5
        moments = [(light * w).sum() / light.sum() for w in (rows, columns, rows**2, columns**2)]
        found = [*moments[2:], *moments[:2], (light * rows * columns).sum() / light.sum(), 0, 0, 0]
        return torch.tensor(found, dtype=torch.float32)


def _performance(arrays) -> list[FrameRecord]:
    """Turns, nods, talks and moves before a camera that stands aside."""
    records = []
    for k in range(FRAMES):
        phase = 2 * np.pi * k / FRAMES
        expression = np.zeros(arrays.num_expressions)
        expression[k % 3] = 0.8
        theta = {
            "expression": expression,
            "rotation": np.array([0.1 * np.cos(phase), 0.5 * np.sin(phase) + 0.2, 0.05 * k]),
            "translation": np.array([0.02 * np.cos(phase), 0.01 * k, 0.03]),
            "jaw": np.array([0.1 + 0.05 * k, 0.0, 0.0]),
        }
        view = np.eye(4)
        view[:3, :3] = np.array([[0.96, 0, -0.28], [0, -1, 0], [-0.28, 0, -0.96]])
        view[:3, 3] = [0.0, 0.05, 0.9]
        camera = CameraRecord(view, np.full(2, 1.9 * SIZE), np.full(2, SIZE / 2))
        records.append(FrameRecord(k, FrameImage(Path()), theta, camera))
    return records


def _written(folder, avatar, records, size=SIZE) -> TrackedDataset:
    """The performance as the avatar itself looks in it."""
    layout, scale = avatar.layout, size / SIZE
    writer = DatasetWriter(folder, avatar.head.arrays, avatar.identity, layout, size, size)
    for record in records:
        theta = layout.join({name: torch.from_numpy(v).float() for name, v in record.theta.items()})
        camera = PinholeCameras(
            torch.from_numpy(record.camera.world_to_camera).float()[None],
            torch.from_numpy(record.camera.focal_px).float()[None] * scale,
            torch.from_numpy(record.camera.principal_point_px).float()[None] * scale,
            size,
            size,
        )
        (image,) = pictures(avatar, theta[None], camera, BLACK)
        opaque = np.full((*image.shape[:2], 1), 255, np.uint8)
        writer.add(TrackedFrame(record.index, theta, camera, np.concatenate([image, opaque], -1)))
    return writer.finish(TEST)


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    """One whose bases show whatever its network hears of theta."""
    torch.manual_seed(0)
    head = HeadModel.embedded()
    config = replace(SMALL, theta_within_film=False)
    made = Avatar(head, torch.zeros(head.num_identity), config)
    with torch.no_grad():
        made.blendshapes.basis_position.normal_(0, 0.002)
        made.blendshapes.basis_color_feature.normal_(0, 0.05)
        for weights in made.weight_network.parameters():
            weights.normal_(0, 0.5)
        made.blendshapes.color_feature.normal_(0.0, 1.0)
    return made


def _placed(avatar, kind, first):
    """As an importer leaves the performance: counted from its frame `first`, or in the cameras."""
    arrays, identity = avatar.head.arrays, avatar.identity.double().numpy()
    records = place_head_pose(_performance(arrays), arrays, identity, "camera")
    if kind == "camera":
        return records
    placed = place_head_pose(records[first:] + records[:first], arrays, identity, "head")
    return sorted(placed, key=lambda record: record.index)


@pytest.mark.parametrize("size", [SIZE, 2 * SIZE])
@pytest.mark.parametrize(
    ("own_kind", "driver_kind"), [("head", "head"), ("camera", "head"), ("camera", "camera")]
)
def test_a_perfect_copy_scores_nothing(avatar, tmp_path, own_kind, driver_kind, size):
    film = _placed(avatar, own_kind, 0)
    own = _written(tmp_path / "own", avatar, film)
    driver = _written(tmp_path / "driver", avatar, _placed(avatar, driver_kind, 2), size)
    # The driver's pictures show the film itself, not what the network makes of the driver's theta.
    true = _written(tmp_path / "true", avatar, film, size)
    driver = replace(driver, image_paths=true.image_paths)
    values, _ = reenactment_scores(avatar, own, driver, Moments(), None)
    assert values == {"aed": pytest.approx(0, abs=LIMIT), "apd": pytest.approx(0, abs=LIMIT)}
    if driver_kind == "head":
        # The first frames differ: before the avatar's own first camera this would be no copy.
        before = pictures(avatar, driver.theta[list(driver.test)], own.cameras.select([0]), BLACK)
        seen = [driver.read_image(k)[..., :3] for k in driver.test]
        assert tracked_distances(zip(seen, before), Moments())["apd"] > 100 * LIMIT


def test_a_film_with_the_head_in_theta_is_driven_by_one_with_it_in_the_cameras(avatar, tmp_path):
    """The avatar's theta then is its own film's, though the driver's head never turns in theta."""
    own = _written(tmp_path / "own", avatar, _placed(avatar, "head", 0))
    driver = _written(tmp_path / "driver", avatar, _placed(avatar, "camera", 0))
    driver = replace(driver, image_paths=own.image_paths)
    values, _ = reenactment_scores(avatar, own, driver, Moments(), None)
    assert values == {"aed": pytest.approx(0, abs=LIMIT), "apd": pytest.approx(0, abs=LIMIT)}


def test_another_head_is_seen_turned_and_placed_as_the_drivers(avatar, tmp_path):
    """Of another identity: the same turn, the middle between the eyes in the same place."""
    own = _written(tmp_path / "own", avatar, _placed(avatar, "head", 0))
    identity = torch.zeros(avatar.head.num_identity)
    identity[:3] = 1.5
    other = Avatar(avatar.head, identity, avatar.config)
    driver = _written(tmp_path / "driver", other, _placed(other, "head", 3))
    chosen = list(driver.test)
    options = DrivingOptions(relative="off", pose="absolute")
    mapped = driven_by(avatar, driver, chosen, statistics_of(avatar, own), 25.0, options)
    theta, cameras = seen_pose.as_seen(mapped, avatar, own, driver, chosen)
    theirs = driver.cameras.select(chosen)
    assert torch.allclose(
        turn_seen(theta, cameras.world_to_camera, avatar.layout),
        turn_seen(driver.theta[chosen], theirs.world_to_camera, driver.layout),
        atol=1e-3,
    )
    eyes, their_eyes = (
        seen_pose.eyes_px(avatar.head, person, numbers, views).mean(1)
        for person, numbers, views in (
            (avatar.identity, theta, cameras),
            (identity, driver.theta[chosen], theirs),
        )
    )
    assert eyes == pytest.approx(their_eyes, abs=0.1)
    # Its network hears of turns that its own camera would have seen.
    assert torch.allclose(
        cameras.world_to_camera,
        own.cameras.world_to_camera[:1].expand(len(chosen), 4, 4),
        atol=1e-4,
    )
