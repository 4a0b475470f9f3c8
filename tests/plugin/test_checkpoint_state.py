"""States of before: what they lack of a prior is what a fresh one has, until it looks."""

import torch

from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.plugin.checkpoint_state import with_prior
from tests.avatar.prior.test_mesh_field import embedded_avatar
from tests.avatar.prior.test_outline import drawn_thicker, front_camera, turned
from tests.avatar.prior.test_surface_prior import shaken


def test_a_run_of_before_is_held_from_its_next_look_on():
    avatar = embedded_avatar()
    theta = turned(avatar, [-8.0, 0.0, 8.0])
    images = drawn_thicker(avatar, theta, 0.0)
    begun, resumed = SurfacePrior(avatar), SurfacePrior(avatar)
    begun.begin(avatar, theta, front_camera(), images)
    shaken(avatar)
    begun.look(avatar, theta, front_camera(), images)
    begun.pull(avatar, 199)
    begun.views.hair_contrast.fill_(0.1)
    state = {f"prior.{name}": value for name, value in begun.state_dict().items()}
    for name in ("leashed_position", "leash_share", "grazing_px", "views.hair_contrast"):
        del state[f"prior.{name}"]
    state = with_prior(state, resumed)
    resumed.load_state_dict({name.removeprefix("prior."): value for name, value in state.items()})
    assert resumed.has_begun
    assert torch.equal(resumed.seen_px, begun.seen_px)
    assert float(resumed.views.hair_contrast) == 0  # its back stays plain
    before = avatar.blendshapes.position.detach().clone()
    resumed.hold(avatar)
    assert torch.equal(avatar.blendshapes.position.detach(), before)
    resumed.look(avatar, theta, front_camera(), images)
    resumed.pull(avatar, 239)
    assert torch.equal(resumed.leash_share, begun.leash_share)
    resumed.hold(avatar)
    assert not torch.equal(avatar.blendshapes.position.detach(), before)
