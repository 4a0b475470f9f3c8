import json

import pytest
import torch

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.storage.bundle import load_statistics
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import ThetaLayout
from tests.avatar.small_head import random_theta


def _statistics(avatar: Avatar, count: int = 12) -> TrainingStatistics:
    theta = random_theta(avatar.layout, count)
    with torch.no_grad():
        return TrainingStatistics.of(theta, avatar.weights(theta), avatar.layout)


def test_statistics_and_layout_are_inside_the_bundle(make_avatar, tmp_path):
    avatar = make_avatar(random=True)
    written = _statistics(avatar)
    avatar.save(tmp_path / "me", statistics=written)
    read = load_statistics(tmp_path / "me")
    assert read is not None
    for name, value in vars(written).items():
        same = getattr(read, name)
        assert torch.equal(same, value) if isinstance(value, torch.Tensor) else same == value
    manifest = json.loads((tmp_path / "me" / "avatar.json").read_text())
    assert ThetaLayout.from_json(manifest["layout"]) == avatar.layout
    assert Avatar.load(tmp_path / "me").layout == avatar.layout


def test_a_bundle_may_have_none_and_a_run_has_none(make_avatar, tmp_path):
    make_avatar().save(tmp_path / "me")
    assert load_statistics(tmp_path / "me") is None
    assert load_statistics(tmp_path) is None


def test_statistics_that_lack_a_part_are_refused(make_avatar, tmp_path):
    avatar = make_avatar()
    avatar.save(tmp_path / "me", statistics=_statistics(avatar))
    path = tmp_path / "me" / "avatar.json"
    manifest = json.loads(path.read_text())
    del manifest["statistics"]["psi_max"]
    path.write_text(json.dumps(manifest))
    with pytest.raises(UserError, match="lack psi_max"):
        load_statistics(tmp_path / "me")
    del manifest["state"]["anchors"]
    path.write_text(json.dumps(manifest))
    with pytest.raises(UserError, match=r"damaged.*lacks anchors"):
        Avatar.load(tmp_path / "me")


def test_values_worked_by_hand(make_avatar):
    avatar = make_avatar()
    layout = avatar.layout
    theta = torch.zeros(3, layout.size)
    theta[:, 0] = torch.tensor([0.3, 0.9, 0.6])
    theta[:, layout.slice("neck").start] = torch.tensor([9.0, 0.0, 3.0])
    psi = torch.tensor([[1.0], [-2.0], [0.5]])
    seen = TrainingStatistics.of(theta, psi, layout)
    assert seen.num_frames == 3
    assert seen.theta_mean[0].item() == pytest.approx(0.6)
    assert seen.theta_std[0].item() == pytest.approx(0.06**0.5)
    assert (seen.psi_min.item(), seen.psi_max.item()) == (-2.0, 1.0)
    # The pose does not decide which frame is at rest, nor is it a component.
    assert torch.equal(seen.theta_neutral, theta[0])
    expected = torch.zeros(layout.size)
    expected[0] = 1
    assert len(seen.components) == 1
    assert torch.allclose(seen.components[0].abs(), expected)
    assert seen.component_max.item() == pytest.approx(0.3)


def test_a_single_frame_and_none(make_avatar):
    avatar = make_avatar()
    theta = random_theta(avatar.layout, 1)
    seen = TrainingStatistics.of(theta, torch.zeros(1, 2), avatar.layout)
    other = random_theta(avatar.layout, 4, seed=1)
    held = seen.project(other)
    assert torch.allclose(held[:, seen.expressive], theta[:, seen.expressive].expand(4, -1))
    with pytest.raises(UserError, match="no training frames"):
        TrainingStatistics.of(theta[:0], torch.zeros(0, 2), avatar.layout)
