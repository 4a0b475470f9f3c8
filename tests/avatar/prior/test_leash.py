"""The leash: neighbours keep together where expressions move the face, and nothing else changes."""

import math

import pytest
import torch

from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.prior.leash import Leash
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep
from rgbavatar_ns.head.arrays import EMBEDDED_BUST, EMBEDDED_HEAD
from rgbavatar_ns.head.joints import JAW

from .test_mesh_field import embedded_avatar
from .test_outline import drawn_thicker, front_camera, turned


@pytest.fixture
def avatar():
    return embedded_avatar(uv_resolution=96)


@pytest.fixture
def leash(avatar) -> Leash:
    return Leash(avatar, MeshField(avatar))


def in_head(avatar, tangent: torch.Tensor) -> torch.Tensor:
    rest = avatar.carrier_vertices(torch.zeros(1, avatar.layout.size))
    return torch.einsum("nij,nj->ni", avatar.anchors.frames(rest).matrix[0], tangent)


def in_frames(avatar, offset: torch.Tensor) -> torch.Tensor:
    rest = avatar.carrier_vertices(torch.zeros(1, avatar.layout.size))
    return torch.linalg.solve(avatar.anchors.frames(rest).matrix[0], offset[..., None])[..., 0]


def test_an_offset_that_all_have_in_common_stays(avatar, leash):
    random = torch.Generator().manual_seed(0)
    home = 1e-3 * torch.randn(avatar.num_gaussians, 3, generator=random)
    common = torch.tensor([0.004, -0.002, 0.006]).expand(avatar.num_gaussians, 3)
    position = home + in_frames(avatar, common)
    found = leash.smooth(position, home, torch.ones(avatar.num_gaussians))
    assert float((in_head(avatar, found - position)).norm(dim=1).max()) < 1e-4


def test_offsets_of_one_apart_from_its_neighbours_are_averaged_away(avatar, leash):
    random = torch.Generator().manual_seed(0)
    alone = 5e-3 * torch.randn(avatar.num_gaussians, 3, generator=random)
    home = torch.zeros(avatar.num_gaussians, 3)
    found = leash.smooth(in_frames(avatar, alone), home, torch.ones(avatar.num_gaussians))
    left = in_head(avatar, found).square().mean() / alone.square().mean()
    assert float(left) < 0.25


def test_what_nothing_knows_follows_what_is_known(avatar, leash):
    """Gaussians whose own offset counts for nothing take that of the others around them."""
    random = torch.Generator().manual_seed(0)
    counts = (torch.rand(avatar.num_gaussians, generator=random) > 0.2).float()
    offset = torch.tensor([0.0, 0.0, 0.004]).repeat(avatar.num_gaussians, 1)
    offset[counts == 0] = 0.1
    home = torch.zeros(avatar.num_gaussians, 3)
    found = in_head(avatar, leash.smooth(in_frames(avatar, offset), home, counts))
    assert float((found - torch.tensor([0.0, 0.0, 0.004])).norm(dim=1).median()) < 1e-4


def test_it_holds_where_the_face_moves(avatar, leash):
    share = leash.share(avatar)
    most = float(share.max())
    assert most == pytest.approx(0.01)
    arrays, (corners, barycentric) = avatar.head.arrays, avatar.anchors.corners()

    def at(values: torch.Tensor) -> torch.Tensor:
        return (values[corners] * barycentric).sum(1)

    # A jaw opened by .3 rad turns every edge of the chin: it changes by 2 sin(.15) of its length.
    of_jaw = at(torch.as_tensor(arrays.skinning_weights[:, JAW]).float()) > 0.999
    assert int(of_jaw.sum()) > 20
    by_hand = most * min(1.0, 2 * math.sin(0.15) / 0.3)
    assert float(share[of_jaw].min()) > 0.98 * by_hand


@pytest.mark.parametrize("name", [EMBEDDED_HEAD, EMBEDDED_BUST])
def test_it_lets_hair_go_and_what_carries_the_head(name):
    avatar = embedded_avatar(uv_resolution=96, name=name)
    field = MeshField(avatar)
    share = Leash(avatar, field).share(avatar) / 0.01
    hair = field.at_gaussians(field.scalp.float()[:, None])[:, 0] > 0.99
    assert int(hair.sum()) > 200
    assert float(share[hair].mean()) < 0.01
    assert float(share[hair].max()) < 0.2


def test_a_film_that_moves_the_face_needs_none(avatar, leash):
    speech, everything = torch.zeros(2, avatar.layout.size), torch.zeros(2, avatar.layout.size)
    part, jaw = avatar.layout.slice("expression"), avatar.layout.slice("jaw").start
    speech[1, part], speech[1, jaw] = 0.25, 0.25 * 0.3
    everything[1, part], everything[1, jaw] = 0.6, 0.6 * 0.3
    before = leash.share(avatar)
    avatar.widen_film_range(speech)
    assert torch.allclose(leash.share(avatar), before, atol=1e-6)
    avatar.widen_film_range(0.375 / 0.25 * speech)
    assert torch.allclose(leash.share(avatar), before / 2, atol=1e-6)
    avatar.widen_film_range(everything)
    assert not leash.share(avatar).any()


def test_every_step_draws_by_the_share_once_it_is_known(avatar):
    theta = turned(avatar, [-8.0, 0.0, 8.0])
    images = drawn_thicker(avatar, theta, 0.0)
    prior, free = SurfacePrior(avatar), avatar.blendshapes.position
    batch = TrainingBatch(theta, front_camera(), images)
    take = TrainingStep(avatar, options=TrainingOptions(first_colors=None), prior=prior)
    take(batch, 0)
    assert not prior.leash_share.any(), "until it has been looked"
    prior.leashed_position.copy_(torch.rand_like(prior.leashed_position))
    prior.leash_share.fill_(1.0)
    take(batch, 1)
    assert torch.equal(free.detach(), prior.leashed_position)
    prior.look(avatar, theta, front_camera(), images)
    prior.pull(avatar, 199)
    assert torch.equal(prior.leash_share, Leash(avatar, MeshField(avatar)).share(avatar))
