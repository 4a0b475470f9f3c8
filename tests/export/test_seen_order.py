"""Which Gaussians come first."""

import torch

from rgbavatar_ns.export.seen_order import seen_order
from rgbavatar_ns.export.views import front_camera

from .subject import avatar_of


def test_what_nobody_sees_comes_last_and_any_start_covers_the_head():
    avatar = avatar_of(uv_resolution=48)
    hidden = torch.arange(0, avatar.num_gaussians, 7)
    with torch.no_grad():
        avatar.blendshapes.opacity_logit[hidden] = -9
    theta = torch.zeros(1, avatar.layout.size)
    seen = seen_order(avatar, theta, front_camera(avatar, 96, 96))
    assert torch.equal(seen.order.sort().values, torch.arange(avatar.num_gaussians))
    assert (seen.weight[hidden] == 0).all()
    unseen = int((seen.weight == 0).sum())
    assert (seen.weight[seen.order[-unseen:]] == 0).all()
    # Of each patch the most seen one stands before its second, third ... one.
    place = torch.empty_like(seen.order)
    place[seen.order] = torch.arange(len(place))
    for cell in seen.cell.unique():
        mine = torch.nonzero(seen.cell == cell)[:, 0]
        assert torch.equal(seen.weight[mine].argmax(), place[mine].argmin())
    quarter = seen.cell[seen.order[: avatar.num_gaussians // 4]]
    covered = torch.zeros(len(seen.cell.unique())).index_add_(0, seen.cell, seen.weight)
    important = torch.nonzero(covered > covered.median())[:, 0]
    assert torch.isin(important, quarter).all()


def test_an_avatar_in_another_order_draws_the_same():
    avatar = avatar_of()
    theta = torch.zeros(1, avatar.layout.size)
    camera = front_camera(avatar, 64, 64)
    order = torch.randperm(avatar.num_gaussians, generator=torch.Generator().manual_seed(0))
    again = avatar.with_gaussians(order).render(theta, camera).image
    # Gaussians of the same depth may change places.
    assert torch.allclose(again, avatar.render(theta, camera).image, atol=1e-3)
