"""Morphed Gaussians, their mesh and their moments are what compiled loops read, or are refused."""

import dataclasses

import pytest

from rgbavatar_ns.avatar.training import make_optimizer
from rgbavatar_ns.avatar.training.optimizer_states import AdamStates
from rgbavatar_ns.kernels import available_backends
from tests.avatar.conftest import make_avatar  # noqa: F401
from tests.avatar.fused_scene import far_batch, stir
from tests.avatar.small_head import front_camera, random_theta

pytestmark = [
    pytest.mark.skipif("cpu" not in available_backends(), reason="not compiled"),
    pytest.mark.usefixtures("unchecked_types"),
]


def test_moments_that_would_be_updated_in_a_copy_are_refused(make_avatar):  # noqa: F811
    avatar = stir(make_avatar())
    batch, background = far_batch(avatar, 2)
    renderer = avatar.renderer(batch.theta, batch.cameras)
    renderer.forward_loss(batch.images_rgba, background)
    parameters = AdamStates(avatar, [make_optimizer(avatar)]).next_of_gaussians()
    position = parameters["position"]
    for moment in (position.first_moment.T.contiguous().T, position.first_moment.double()):
        strange = parameters | {
            "position": dataclasses.replace(position, first_moment=moment),
        }
        with pytest.raises(ValueError, match=r"first_moment is .* It is updated where it lies"):
            renderer.backward_adam(strange)
    before = position.value.detach().clone()
    renderer.backward_adam(parameters)
    assert bool((position.value != before).any())


def test_vertices_of_another_mesh_are_refused(make_avatar):  # noqa: F811
    avatar = stir(make_avatar())
    theta, camera = random_theta(avatar.layout, 1), front_camera()
    posed = avatar.carrier_vertices(theta).detach()
    assert avatar.renderer(theta, camera, vertices=posed) is not None
    fewer = int(avatar._morphed_gaussians().triangle_vertices.max())
    with pytest.raises(ValueError, match=f"There are {fewer} vertices, and .* name {fewer + 1}"):
        avatar.renderer(theta, camera, vertices=posed[:, :fewer])
    for _ in range(2):  # the second time they are packed
        avatar.render(theta, camera, to_be_seen=True)
    with pytest.raises(ValueError, match=f"There are {fewer} vertices"):
        avatar.picture_renderer(theta, camera, vertices=posed[:, :fewer])
