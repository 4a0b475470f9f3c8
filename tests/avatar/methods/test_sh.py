import copy
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.special import lpmv

from rgbavatar_ns.avatar.methods.sh import (
    ShownDegree,
    directions_in_frames,
    rotate_sh,
    sh_basis,
    sh_colors,
    shown_colors,
    view_directions,
)
from rgbavatar_ns.avatar.model.blendshapes import color_from_feature
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.kernels import PinholeCameras


def unit(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return F.normalize(torch.randn(*shape, 3, generator=generator, dtype=torch.float64), dim=-1)


def normal(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def cameras_at(centres: torch.Tensor) -> PinholeCameras:
    rotation = axis_angle_to_matrix(normal(len(centres), 3, seed=3))
    pose = torch.eye(4, dtype=torch.float64).repeat(len(centres), 1, 1)
    pose[:, :3, :3], pose[:, :3, 3] = rotation, -(rotation @ centres[..., None])[..., 0]
    two = torch.full((len(centres), 2), 50.0, dtype=torch.float64)
    return PinholeCameras(pose, two, two, 100, 100)


def test_harmonics_are_those_of_legendres_functions_in_order_of_degree_and_m() -> None:
    directions = unit(50)
    x, y, z = directions.numpy().T
    around = np.arctan2(y, x)
    wanted = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            order = abs(m)
            share = math.factorial(degree - order) / math.factorial(degree + order)
            factor = np.sqrt((2 * degree + 1) / (4 * np.pi) * share) * (np.sqrt(2) if m else 1)
            wave = np.sin(order * around) if m < 0 else np.cos(order * around)
            # scipy's function has (-1)^m already.
            wanted.append(factor * lpmv(order, degree, z) * wave)
    np.testing.assert_allclose(sh_basis(directions, 3), np.stack(wanted, 1), atol=1e-12)


def test_harmonics_are_orthonormal_on_the_sphere() -> None:
    # A rule of its own: midpoints around, Gauss-Legendre with more points than are needed.
    heights, weights = np.polynomial.legendre.leggauss(9)
    around = 2 * np.pi * (np.arange(19) + 0.5) / 19
    z, angle = (part.ravel() for part in np.meshgrid(heights, around, indexing="ij"))
    radius = np.sqrt(1 - z**2)
    points = torch.tensor(np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1))
    basis = sh_basis(points, 3) * torch.tensor(np.repeat(weights, 19) * 2 * np.pi / 19)[:, None]
    gram = sh_basis(points, 3).mT @ basis
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_colours_show_along_d_what_was_along_the_direction_turned_back(degree: int) -> None:
    coefficients = 0.1 * normal(2, 30, (degree + 1) ** 2, 3)
    rotations = axis_angle_to_matrix(normal(2, 30, 3, seed=2))
    directions = unit(2, 30)
    turned = sh_colors(rotate_sh(coefficients, rotations), directions, degree)
    back = (torch.linalg.inv(rotations) @ directions[..., None])[..., 0]
    assert turned.min() > 0
    torch.testing.assert_close(turned, sh_colors(coefficients, back, degree))
    torch.testing.assert_close(directions_in_frames(directions, rotations), back)


def test_one_turn_may_serve_all_and_two_turns_are_their_product() -> None:
    coefficients, turns = normal(5, 16, 3), axis_angle_to_matrix(normal(2, 3, seed=4))
    twice = rotate_sh(rotate_sh(coefficients, turns[0]), turns[1])
    torch.testing.assert_close(twice, rotate_sh(coefficients, turns[1] @ turns[0]))


def test_colours_are_the_sum_of_the_first_harmonics_and_never_below_zero() -> None:
    coefficients, directions = normal(4, 16, 3), unit(3, 4)
    for degree in range(4):
        count = (degree + 1) ** 2
        summed = torch.einsum("bnc,ncx->bnx", sh_basis(directions, degree), coefficients[:, :count])
        found = sh_colors(coefficients, directions, degree)
        torch.testing.assert_close(found, (summed + 0.5).clamp(min=0))
        each = coefficients.expand(3, -1, -1, -1)
        torch.testing.assert_close(sh_colors(each, directions, degree), found)
        torch.testing.assert_close(sh_colors(coefficients[None], directions, degree), found)
    assert found.min() == 0


def test_degree_zero_is_the_colour_of_a_feature() -> None:
    feature = 0.3 * normal(4, 1, 3)
    wanted = color_from_feature(feature[:, 0]).expand(2, 4, 3)
    torch.testing.assert_close(sh_colors(feature, unit(2, 4), 0), wanted)


@pytest.mark.parametrize("cameras", [1, 2])
def test_views_go_from_the_cameras_place_to_the_gaussian(cameras: int) -> None:
    centres, directions = normal(cameras, 3), unit(2, 6)
    distance = torch.linspace(0.1, 3, 6, dtype=torch.float64)[:, None]
    found = view_directions(centres[:, None] + distance * directions, cameras_at(centres))
    torch.testing.assert_close(found, directions)


def test_gradients_agree_with_differences() -> None:
    coefficients = (0.05 * normal(3, 16, 3)).requires_grad_()
    means, turns = normal(2, 3, 3, seed=6).requires_grad_(), normal(2, 3, 3, seed=7)
    turns.requires_grad_()
    cameras = cameras_at(normal(2, 3, seed=8) + 4)

    def colors(coefficients, means, turns):
        rotations = axis_angle_to_matrix(turns)
        local = directions_in_frames(view_directions(means, cameras), rotations)
        return sh_colors(coefficients, local, 3), rotate_sh(coefficients, rotations)

    assert torch.autograd.gradcheck(colors, (coefficients, means, turns))


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="degree is 4"):
        sh_basis(unit(2), 4)
    with pytest.raises(ValueError, match="4 coefficients for degree 2"):
        sh_colors(normal(2, 4, 3), unit(1, 2), 2)
    with pytest.raises(ValueError, match="5 coefficients"):
        rotate_sh(normal(2, 5, 3), torch.eye(3, dtype=torch.float64))


class Owner(torch.nn.Module):
    """Shows harmonics up to degree 3."""

    degree: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.shown = ShownDegree(self, "degree", 3)


def test_the_shown_degree_is_the_buffers_wherever_it_changed():
    owner = Owner()
    shown = owner.shown
    assert shown.now == 0
    shown.set(2)
    assert (shown.now, int(owner.degree)) == (2, 2)
    owner.load_state_dict({"degree": torch.tensor(1)})
    assert shown.now == 1
    owner.to(torch.device("meta")).to_empty(device="cpu")  # another tensor by the same name
    owner.degree.fill_(3)
    assert shown.now == 3
    before = owner.degree._version
    shown.set(3)
    assert owner.degree._version == before


@pytest.mark.parametrize("degree", [-1, 4, 127])
def test_a_stored_degree_that_coefficients_have_not_is_told(degree: int):
    owner = Owner()
    with pytest.raises(UserError, match=f"up to degree {degree}, and has those up to 3"):
        owner.load_state_dict({"degree": torch.tensor(degree)})


def test_a_copys_degree_is_its_own():
    owner = Owner()
    copied = copy.deepcopy(owner)
    copied.shown.set(2)
    assert (owner.shown.now, copied.shown.now, int(copied.degree)) == (0, 2, 2)


def test_the_degree_rises_with_the_releases_steps_up_to_the_last() -> None:
    shown = Owner().shown
    degrees = []
    for step in range(12):
        shown.raise_by(step, 3)
        degrees.append(shown.now)
    # Their first step is 1, and what is raised at the beginning of step 3 shows in it.
    assert degrees == [0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 3, 3]


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_colours_are_shown_up_to_the_degree_and_turn_with_what_carries_them(degree: int) -> None:
    owner, means = Owner(), normal(2, 5, 3)
    owner.shown.set(degree)
    flat, rest = 0.3 * normal(5, 1, 3), 0.1 * normal(5, 15, 3, seed=4)
    cameras, turns = cameras_at(normal(2, 3, seed=8) + 4), axis_angle_to_matrix(normal(2, 5, 3))
    directions = view_directions(means, cameras)
    found = shown_colors(flat, rest, owner.shown, means, cameras, turns)
    local = directions_in_frames(directions, turns)
    coefficients = torch.cat([flat, rest], 1)
    torch.testing.assert_close(found.expand(2, -1, -1), sh_colors(coefficients, local, degree))
    plain = shown_colors(flat, rest, owner.shown, means, cameras).expand(2, -1, -1)
    torch.testing.assert_close(plain, sh_colors(coefficients, directions, degree))
    without = shown_colors(flat, rest, owner.shown, means, None)
    torch.testing.assert_close(without, sh_colors(flat, directions[:1], 0))
