"""The compiled way from theta to weights and a posed mesh, beside head and network in float64."""

import copy

import pytest
import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.model.posing_parameters import posing_parameters
from rgbavatar_ns.head import EMBEDDED_BUST, HeadModel
from rgbavatar_ns.kernels import Posing, available_backends, posing_of
from rgbavatar_ns.threads import using_threads
from tests.avatar.small_head import random_theta, randomize, small_head
from tests.kernels.conftest import instruction_set  # noqa: F401

pytestmark = pytest.mark.skipif("cpu" not in available_backends(), reason="not compiled")

VARIANTS = {
    "paper": {},
    "no bases": {"num_bases": 0},
    "many bases": {"num_bases": 37},
    "linear network": {"weight_network": "linear"},
    "expressions themselves": {"weight_network": "none", "num_bases": 3},
    "no pose": {"pose_input": False},
    "translation": {"translation_input": True},
    "no pose but translation": {"pose_input": False, "translation_input": True},
    "joints alone": {"carrier": "joints"},
}


HEADS = {
    "small": lambda request: small_head(),
    "bust": lambda request: HeadModel.embedded(name=EMBEDDED_BUST),
    # With eyelids and pose correctives.
    "flame": lambda request: HeadModel(request.getfixturevalue("flame_2020")),
}


def avatar_on(head: HeadModel, **changes) -> Avatar:
    """Its network moved, its range of theta known for some numbers, narrow for some."""
    identity = 0.3 * torch.randn(head.num_identity, generator=torch.Generator().manual_seed(1))
    changes = {"num_bases": 5, **changes}
    avatar = Avatar(head, identity, AvatarConfig(uv_resolution=8, **changes))
    randomize(avatar)
    for place in range(0, head.layout.size, 3):
        avatar.theta_low[place], avatar.theta_high[place] = -0.2, 0.3
    return avatar


def parts_of(avatar: Avatar):
    film_range = avatar.theta_low, avatar.theta_high
    return avatar.head, avatar.identity, film_range, avatar.weight_network


def compiled(avatar: Avatar) -> Posing:
    posing = posing_of(posing_parameters(*parts_of(avatar), avatar.config))
    assert posing is not None
    return posing


def assert_agrees(avatar: Avatar, seed: int = 0) -> None:
    posing, exact = compiled(avatar), copy.deepcopy(avatar).double()
    for theta in random_theta(avatar.layout, 3, seed).split(1):
        weights, vertices = posing(theta)
        with torch.no_grad():
            expected = exact.weights(theta.double()), exact.carrier_vertices(theta.double())
        assert weights.shape == expected[0].shape
        assert torch.allclose(weights.double(), expected[0], atol=1e-5, rtol=1e-5)
        assert (vertices - expected[1]).abs().max() < 1e-6


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("head", HEADS)
def test_every_head_is_posed_as_in_float64(head, request):
    assert_agrees(avatar_on(HEADS[head](request)))


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_is_weighed_as_in_float64(variant, seed):
    assert_agrees(avatar_on(small_head(), **VARIANTS[variant]), seed)


def test_no_theta_is_the_head_at_rest_to_the_bit():
    avatar = avatar_on(HeadModel.embedded(name=EMBEDDED_BUST))
    theta = torch.zeros(1, avatar.layout.size)
    assert torch.equal(compiled(avatar)(theta)[1], avatar.head(theta, avatar.identity))


@pytest.mark.parametrize("angle", [0.0, 1e-30, 1e-12, 1e-4, 3.0, 6.2832])
def test_any_turn_is_a_turn(angle):
    avatar = avatar_on(small_head())
    theta = torch.zeros(1, avatar.layout.size)
    axis = torch.tensor([0.6, 0.0, -0.8])
    theta[0, avatar.layout.slice("rotation")] = angle * axis
    vertices, at_rest = (compiled(avatar)(one)[1][0].double() for one in (theta, 0 * theta))
    assert torch.allclose(torch.cdist(vertices, vertices), torch.cdist(at_rest, at_rest), atol=1e-6)
    expected = copy.deepcopy(avatar).double().carrier_vertices(theta.double())[0]
    assert (vertices - expected).abs().max() < 1e-6


def test_threads_change_no_bit():
    posing = compiled(avatar_on(HeadModel.embedded(name=EMBEDDED_BUST)))
    theta = random_theta(HeadModel.embedded(name=EMBEDDED_BUST).layout, 1)
    found = []
    for threads in (1, 2, 5):
        with using_threads(threads):
            found.append(posing(theta))
    for weights, vertices in found[1:]:
        assert torch.equal(weights, found[0][0])
        assert torch.equal(vertices, found[0][1])


def test_other_backends_and_types_have_none():
    avatar = avatar_on(small_head())
    parameters = posing_parameters(*parts_of(avatar), avatar.config)
    assert posing_of(parameters, "reference") is None
    avatar = avatar.double()
    assert posing_of(posing_parameters(*parts_of(avatar), avatar.config)) is None


@pytest.mark.parametrize("more", [-1, 1])
def test_a_theta_of_another_size_is_refused(more):
    avatar = avatar_on(small_head())
    theta = torch.zeros(1, avatar.layout.size + more)
    with pytest.raises(ValueError, match=rf"theta is \[1, {theta.shape[1]}\]"):
        compiled(avatar)(theta)
