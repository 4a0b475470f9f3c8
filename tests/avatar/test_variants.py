"""The paper's ablations change what they name and nothing else."""

import pytest
import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.optimizer_states import unsupported_reason
from rgbavatar_ns.errors import UserError

from .small_head import NUM_EXPRESSION, front_camera, random_theta, small_head, small_identity


def _changed(layout, theta, name):
    other = theta.clone()
    other[:, layout.slice(name)] += 0.3
    return other


def test_joints_carry_gaussians_past_expressions_but_not_past_the_jaw(make_avatar):
    avatar = make_avatar(random=True, dtype=torch.float64, carrier="joints")
    mesh = make_avatar(random=True, dtype=torch.float64)
    theta = random_theta(avatar.layout, 2, dtype=torch.float64)
    psi = torch.randn(2, 3, dtype=torch.float64)
    means = avatar.gaussians(theta, psi).means
    smiling = _changed(avatar.layout, theta, "expression")
    torch.testing.assert_close(avatar.gaussians(smiling, psi).means, means, rtol=0, atol=0)
    for name in ("jaw", "rotation", "translation"):
        moved = avatar.gaussians(_changed(avatar.layout, theta, name), psi).means
        assert not torch.allclose(moved, means)
    neutral = theta.clone()
    neutral[:, avatar.layout.slice("expression")] = 0
    same = mesh.gaussians(neutral, psi).means
    torch.testing.assert_close(avatar.gaussians(neutral, psi).means, same)
    assert not torch.allclose(mesh.gaussians(smiling, psi).means, mesh.gaussians(theta, psi).means)


def test_without_a_network_the_first_expressions_are_the_weights(make_avatar):
    avatar = make_avatar(random=True, weight_network="none", num_bases=3)
    theta = random_theta(avatar.layout, 4)
    expressions = theta[:, avatar.layout.slice("expression")]
    torch.testing.assert_close(avatar.weights(theta), expressions[:, :3], rtol=0, atol=0)
    groups = avatar.parameter_groups()
    assert "weight_network" not in groups
    assert groups["basis_color"][0].shape[0] == 3


def test_more_bases_than_expressions_need_a_network():
    config = AvatarConfig(num_bases=NUM_EXPRESSION + 1, weight_network="none", uv_resolution=8)
    with pytest.raises(UserError, match=f"has {NUM_EXPRESSION}"):
        Avatar(small_head(), small_identity(), config)


def test_the_fused_step_trains_both(make_avatar):
    for variant in ({"carrier": "joints"}, {"weight_network": "none"}):
        avatar = make_avatar(random=True, **variant)
        before = {name: p.detach().clone() for name, p in avatar.named_parameters()}
        parameters = [p for group in avatar.parameter_groups().values() for p in group]
        optimizer = torch.optim.Adam(parameters, lr=1e-2)
        assert unsupported_reason(avatar, [optimizer]) is None
        images = torch.randint(0, 256, (2, 16, 16, 4), dtype=torch.uint8)
        step = FusedStep(avatar, [optimizer])
        loss = step(random_theta(avatar.layout, 2), front_camera(16), images, torch.zeros(2, 3))
        if loss is None:
            pytest.skip("no compiled extension")
        moved = [n for n, p in avatar.named_parameters() if not torch.equal(p, before[n])]
        assert {"blendshapes.position", "blendshapes.basis_color_feature"} <= set(moved)
