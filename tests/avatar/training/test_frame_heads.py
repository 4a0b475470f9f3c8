"""Heads of all frames, made once while nothing moves them."""

import torch

from rgbavatar_ns.avatar.training.frame_heads import FrameHeads
from tests.avatar.fused_scene import far_batch, stir


def _agrees(heads: FrameHeads, avatar, theta: torch.Tensor) -> bool:
    return torch.allclose(heads.vertices, avatar.carrier_vertices(theta), atol=1e-6) and (
        torch.allclose(avatar.weights_of(heads.features), avatar.weights(theta), atol=1e-6)
    )


def test_rows_are_the_avatar_s_own_and_made_once(make_avatar):
    avatar = stir(make_avatar())
    theta, heads = far_batch(avatar, 3)[0].theta, FrameHeads(avatar)
    heads.know(theta)
    assert _agrees(heads, avatar, theta)
    before = heads.vertices
    heads.know(theta)
    assert heads.vertices is before


def test_what_moves_a_head_makes_it_anew(make_avatar):
    avatar = stir(make_avatar())
    theta, heads = far_batch(avatar, 3)[0].theta, FrameHeads(avatar)
    heads.know(theta)
    for move in (
        lambda: theta.add_(0.05),
        lambda: avatar.identity.add_(0.1),
        lambda: (avatar.theta_low.fill_(-0.01), avatar.theta_high.fill_(0.01)),
    ):
        before = heads.vertices
        move()
        heads.know(theta)
        assert heads.vertices is not before
        assert _agrees(heads, avatar, theta)
