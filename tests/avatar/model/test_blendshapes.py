import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.avatar import TangentBlendshapes
from rgbavatar_ns.avatar.model.blendshapes import color_from_feature, feature_from_color


def filled(num_gaussians: int, num_bases: int, seed: int = 0) -> TangentBlendshapes:
    shapes = TangentBlendshapes(num_gaussians, num_bases).double()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in shapes.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    return shapes


@settings(max_examples=20, deadline=None)
@given(
    num_gaussians=st.integers(1, 5),
    num_bases=st.integers(1, 4),
    batch=st.integers(1, 3),
    seed=st.integers(0, 99),
)
def test_blend_is_base_plus_weighted_residuals(num_gaussians, num_bases, batch, seed):
    shapes = filled(num_gaussians, num_bases, seed)
    psi = torch.randn(
        batch, num_bases, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    blended = shapes.morph(psi)
    for name in ("position", "rotation_wxyz", "color_feature"):
        base = getattr(shapes, name).detach().numpy()
        bases = getattr(shapes, f"basis_{name}").detach().numpy()
        expected = base + np.einsum("bk,knc->bnc", psi.numpy(), bases)
        np.testing.assert_allclose(getattr(blended, name).detach().numpy(), expected, atol=1e-12)


def test_opacity_and_scale_have_no_residuals():
    shapes = TangentBlendshapes(5, 3)
    assert {name for name, _ in shapes.named_parameters() if name.startswith("basis")} == {
        "basis_position",
        "basis_rotation_wxyz",
        "basis_color_feature",
    }


def test_without_bases_the_blend_is_the_base():
    shapes = filled(4, 0)
    assert not any(name.startswith("basis") for name, _ in shapes.named_parameters())
    blended = shapes.morph(torch.zeros(3, 0, dtype=torch.float64))
    torch.testing.assert_close(blended.position, shapes.position.expand(3, -1, -1))


def test_initial_values():
    shapes = TangentBlendshapes(4, 2, scale_m=8e-4, opacity=0.25, color=0.75)
    blended = shapes.morph(torch.randn(1, 2))
    torch.testing.assert_close(blended.position, torch.zeros(1, 4, 3))
    identity = torch.tensor([1.0, 0, 0, 0]).expand(1, 4, 4)
    torch.testing.assert_close(blended.rotation_wxyz, identity)
    torch.testing.assert_close(blended.log_scale.exp(), torch.full((4, 3), 8e-4))
    torch.testing.assert_close(blended.opacity_logit.sigmoid(), torch.full((4,), 0.25))
    torch.testing.assert_close(
        color_from_feature(blended.color_feature), torch.full((1, 4, 3), 0.75)
    )


def test_color_activation_is_the_zeroth_harmonic():
    # A feature of 1 is worth 1 / (2 sqrt(pi)); a feature of 0 is mid grey.
    feature = torch.tensor([[0.0, 1.0, -2.0]], dtype=torch.float64)
    constant = 0.5 / np.sqrt(np.pi)
    expected = torch.tensor([[0.5, 0.5 + constant, 0.5 - 2 * constant]], dtype=torch.float64)
    torch.testing.assert_close(color_from_feature(feature), expected)
    torch.testing.assert_close(feature_from_color(color_from_feature(feature)), feature)


@pytest.mark.parametrize("num_bases", [0, 2])
def test_one_scale_a_gaussian_can_be_given(num_bases):
    scale_m = torch.tensor([1e-3, 2e-3, 4e-3])
    shapes = TangentBlendshapes(3, num_bases, scale_m=scale_m)
    torch.testing.assert_close(shapes.log_scale.exp(), scale_m[:, None].expand(3, 3))
