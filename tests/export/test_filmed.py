"""What a film's pictures could not show is known by where it lies."""

from dataclasses import replace
from pathlib import Path

import torch

from rgbavatar_ns.export import front_camera, within_film
from tests.data.small_dataset import small_dataset

from .subject import avatar_of

_WIDTH, _HEIGHT = 64, 40


def test_what_lies_below_every_picture_is_told_and_what_is_behind_others_stays(tmp_path: Path):
    avatar = avatar_of()
    dataset = small_dataset(tmp_path / "data", avatar.head)
    # From the front, cut at the camera's own height in every second frame, higher in the others.
    camera = front_camera(avatar, _WIDTH, _HEIGHT)
    cameras = camera.select([0] * len(dataset))
    principal = cameras.principal_point_px.clone()
    principal[::2, 1] = _HEIGHT
    principal[1::2, 1] = _HEIGHT + 7
    dataset = replace(
        dataset,
        theta=torch.zeros_like(dataset.theta),
        cameras=replace(cameras, principal_point_px=principal, focal_px=cameras.focal_px / 2),
        width=_WIDTH,
        height=_HEIGHT,
    )
    kept = within_film(avatar, dataset)
    # What is above the camera is seen above its principal point, however far it is behind others.
    with torch.no_grad():
        means = avatar.gaussians(dataset.theta[:1]).means[0]
    camera_y = -camera.world_to_camera[0, 1, 3] * camera.world_to_camera[0, 1, 1]
    assert torch.equal(kept, means[:, 1] >= camera_y)
    assert 0.2 < kept.float().mean() < 0.8
