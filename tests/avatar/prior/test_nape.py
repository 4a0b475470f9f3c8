"""The hairline behind the neck: lower in the middle, ragged, between hair and skin."""

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.prior.mesh_field import NECK_HAIR_M, MeshField
from rgbavatar_ns.avatar.prior.strands import Strands
from rgbavatar_ns.head.arrays import EMBEDDED_BUST, EMBEDDED_HEAD

from .test_mesh_field import embedded_avatar

DARK, LIGHT = (0.1, 0.2, 0.3), (0.9, 0.8, 0.7)


@pytest.fixture(scope="module", params=[EMBEDDED_HEAD, EMBEDDED_BUST])
def drawn(request):
    """Places behind the eyes, above the end of the mesh's hair and aside; colours; strands."""
    avatar = embedded_avatar(name=request.param, uv_resolution=192)
    field = MeshField(avatar)
    strands = Strands.of(avatar, field)
    colors = torch.where(field.haired[:, None], torch.tensor(DARK), torch.tensor(LIGHT))
    height_m = field.above_eyes_m + NECK_HAIR_M
    places = torch.stack([field.behind_eyes_m, height_m, field.rest_m[:, 0]], 1)
    plain = field.at_gaussians(colors)
    colored = strands.nape.colored(plain, colors, torch.tensor(0.1))
    assert torch.equal(strands.nape.colored(plain, colors, torch.tensor(0.0)), plain), "as of caps"
    return field.at_gaussians(places), plain, colored, strands


def _dark(colors):
    """Share of hair by colour."""
    return ((LIGHT[0] - colors[:, 0]) / (LIGHT[0] - DARK[0])).numpy()


def test_hair_reaches_lower_in_the_middle_of_the_neck(drawn):
    (behind, up, aside), _, colored, strands = (drawn[0].unbind(1), *drawn[1:])
    back = (behind > 0.11).numpy()
    dark, up, aside = _dark(colored), up.numpy(), aside.abs().numpy()
    between = back & (up > -0.015) & (up < -0.005)
    middle, sides = between & (aside < 0.02), between & (aside > 0.035)
    assert min(int(middle.sum()), int(sides.sum())) > 20
    assert dark[middle].mean() > 0.75
    assert dark[sides].mean() < 0.4
    assert dark[back & (aside < 0.02) & (up > 0.005)].min() > 0.99
    # And every strand ends by itself, above the collar.
    there = back & (strands.nape.hair.numpy() > 0.5) & (up < 0)
    assert dark[there].min() > 0.4
    assert up[there].min() > -0.036


def test_its_line_is_ragged_and_what_is_not_there_stays_as_it_was(drawn):
    (behind, up, aside), plain, colored, strands = (drawn[0].unbind(1), *drawn[1:])
    middle = ((behind > 0.11) & (aside.abs() < 0.015)).numpy()
    dark, up = _dark(colored), up.numpy()
    row = middle & (np.abs(up + 0.02) < 0.004)
    assert int(row.sum()) >= 10
    assert dark[row].std() > 0.25, "hair beside skin at one height"
    away = strands.nape.near == 0
    assert int(away.sum()) > 0.9 * len(away)
    assert torch.equal(colored[away], plain[away])
    assert bool((away | (drawn[0][:, 0] > 0.095)).all()), "ears and cheeks are not its business"


def test_hair_below_the_mesh_s_has_strands_too_and_skin_above_it_none(drawn):
    _, _, colored, strands = drawn
    near, dark = (strands.nape.near > 0.99).numpy(), _dark(colored)
    haired = strands.haired.numpy()
    np.testing.assert_allclose(haired[near], dark[near], atol=0.02)
    assert float(strands.pattern[near & (haired > 0.99)].abs().mean()) > 0.2
    assert float(strands.pattern[near & (haired < 0.01)].abs().max()) < 0.05
