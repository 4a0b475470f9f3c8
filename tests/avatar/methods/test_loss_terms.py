import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from rgbavatar_ns.avatar.methods.loss_terms import (
    coverage_loss,
    cylinder_term,
    dssim_loss,
    held_where,
    huber_loss,
    mse_loss,
    position_hinge,
    scale_hinge,
    spike_term,
    upright_cylinder,
)
from rgbavatar_ns.avatar.metrics import ssim
from rgbavatar_ns.drawing.compositing import film_over
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA


def pictures(*shape: int, seed: int = 0, dtype=torch.float64) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_squared_and_huber_by_hand() -> None:
    image = torch.zeros(1, 1, 2, 3)
    target = torch.tensor([[[[0.1, -0.05, 0.0], [0.0, 0.0, -0.6]]]])
    assert mse_loss(image, target).item() == pytest.approx((0.01 + 0.0025 + 0.36) / 6)
    near, far = 0.005 + 0.00125, 0.1 * (0.6 - 0.05)
    assert huber_loss(image, target).item() == pytest.approx((near + far) / 6)
    for mask in (torch.tensor([[[True, False]]]), torch.tensor([[[1.0, 0.0]]])):
        assert huber_loss(image, target, weight=mask).item() == pytest.approx(near / 6)
    assert huber_loss(image, target, weight=torch.full((1, 1, 2), 40.0)).item() == pytest.approx(
        40 * (near + far) / 6
    )


def similarity_within(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Torchmetrics' mean SSIM over the windows that lie within the picture."""
    _, whole = structural_similarity_index_measure(
        image.movedim(-1, 1), target.movedim(-1, 1), data_range=1.0, return_full_image=True
    )
    return whole[..., 5:-5, 5:-5].mean()


@pytest.mark.parametrize("shape", [(2, 40, 33, 3), (1, 11, 11, 3)])
def test_dssim_is_one_less_the_metric(shape) -> None:
    image, target = pictures(*shape), pictures(*shape, seed=1)
    smooth = 0.7 * target + 0.3 * image
    for first, second in ((image, target), (smooth, target), (image * 0, target), (image, image)):
        wanted = 1 - similarity_within(first, second)
        torch.testing.assert_close(dssim_loss(first, second), wanted, atol=1e-9, rtol=1e-9)
    single = dssim_loss(smooth.float(), target.float())
    assert single.item() == pytest.approx(dssim_loss(smooth, target).item(), abs=1e-5)


def test_what_is_held_is_the_same_picture_without_a_gradient() -> None:
    image, target = pictures(1, 14, 13, 3).requires_grad_(), pictures(1, 14, 13, 3, seed=1)
    unfilmed = torch.zeros(1, 14, 13, dtype=torch.bool)
    unfilmed[:, 3:9, 2:] = True
    held = held_where(image, unfilmed)
    assert torch.equal(held, image)
    (found,) = torch.autograd.grad(dssim_loss(held, target), image)
    (wanted,) = torch.autograd.grad(dssim_loss(image, target), image)
    assert torch.equal(found[~unfilmed], wanted[~unfilmed])
    assert not found[unfilmed].any()
    assert not held_where(image.detach(), unfilmed).requires_grad


def test_at_a_films_size_dssim_is_the_evaluations() -> None:
    image = pictures(1, 256, 256, 3, dtype=torch.float32)
    target = (image + 0.2 * pictures(1, 256, 256, 3, seed=1, dtype=torch.float32)).clamp(max=1)
    # They differ by what is made of the border.
    wanted = 1 - ssim(image, target).mean().item()
    assert dssim_loss(image, target).item() == pytest.approx(wanted, rel=0.01)


def test_dssims_gradient_agrees_with_differences_and_with_autograd() -> None:
    image, target = pictures(2, 14, 13, 3).requires_grad_(), pictures(2, 14, 13, 3, seed=1)
    both = (image, target.clone().requires_grad_())
    assert torch.autograd.gradcheck(dssim_loss, both, fast_mode=True)
    (found,) = torch.autograd.grad(2 * dssim_loss(image, target), image)
    (wanted,) = torch.autograd.grad(-2 * similarity_within(image, target), image)
    torch.testing.assert_close(found, wanted)
    (found,) = torch.autograd.grad(dssim_loss(target, image), image)
    torch.testing.assert_close(2 * found, wanted)


def test_pictures_smaller_than_the_window_are_refused() -> None:
    with pytest.raises(ValueError, match="11 pixels"):
        dssim_loss(torch.zeros(1, 10, 20, 3), torch.zeros(1, 10, 20, 3))


def test_what_nobody_filmed_adds_nothing_to_terms_pixel_by_pixel() -> None:
    image = pictures(1, 12, 9, 3, dtype=torch.float32).requires_grad_()
    rgba = torch.full((1, 12, 9, 4), 200, dtype=torch.uint8)
    rgba[:, 8:] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    target = film_over(rgba, torch.zeros(1, 3), image.detach())
    for loss in (mse_loss, huber_loss):
        (gradient,) = torch.autograd.grad(loss(image, target), image)
        assert not gradient[:, 8:].any()
        assert gradient[:, :8].all()


def test_coverage_by_hand() -> None:
    alpha = torch.tensor([[[[0.5], [1.0], [0.0]]]])
    matte, counted = torch.tensor([[[0.0, 1.0, 1.0]]]), torch.tensor([[[True, True, False]]])
    assert coverage_loss(alpha, matte).item() == pytest.approx(1.25 / 3)
    assert coverage_loss(alpha, matte, counted).item() == pytest.approx(0.25 / 3)


def test_hinges_by_hand() -> None:
    position = torch.tensor([[3.0, 4, 0], [0.5, 0, 0], [0, 2, 0], [0, 0, 9]])
    seen = torch.tensor([True, True, True, False])
    assert position_hinge(position).item() == pytest.approx((4 + 0 + 1 + 8) / 4)
    assert position_hinge(position, seen=seen).item() == pytest.approx(5 / 3)
    scales = torch.tensor([[3.6, 4.6, 0.1], [0.5, 0.6, 0.6], [0.1, 1.6, 0.1], [9, 9, 9]])
    assert scale_hinge(scales, seen=seen).item() == pytest.approx((5 + 0 + 1) / 3)
    nobody = torch.zeros(4, dtype=torch.bool)
    assert position_hinge(position, seen=nobody) == scale_hinge(scales, seen=nobody) == 0


def test_only_spikes_are_held() -> None:
    # A spike; large but round; thin but small; another spike.
    scales = torch.tensor(
        [[[0.004, 0.0003, 0.004], [0.02, 0.01, 0.02], [0.0019, 1e-5, 1e-5], [0.006, 1e-4, 0.001]]]
    ).requires_grad_()
    term = spike_term(scales, 0.002)
    assert term.item() == pytest.approx((0.004 + 0.006) / 2)
    (gradient,) = torch.autograd.grad(term, scales)
    assert (gradient[0] != 0).any(-1).tolist() == [True, False, False, True]
    assert spike_term(scales, 0.1).item() == 0


def test_distance_to_a_cylinder_by_hand() -> None:
    centre = torch.tensor([1.0, 2, 3])
    offsets = torch.tensor([[0.0, 0, 0], [3, 0, 4], [0, -2.5, 1], [2, 2, 0]])
    found = cylinder_term(centre + offsets, centre, radius=1.0, half_height=0.5)
    assert found.item() == pytest.approx((0 + 16 + 4 + (1 + 2.25)) / 4)


def test_an_upright_cylinder_holds_its_points_and_no_more() -> None:
    points = 0.1 * pictures(9, 3)
    centre, radius, half_height = upright_cylinder(points)
    assert cylinder_term(points, centre, radius, half_height).item() == pytest.approx(0, abs=1e-12)
    assert cylinder_term(points, centre, 0.99 * radius, half_height) > 1e-9
    assert cylinder_term(points, centre, radius, 0.99 * half_height) > 1e-9
    low, high = points.amin(0), points.amax(0)
    torch.testing.assert_close(centre, (low + high) / 2)
    assert upright_cylinder(points[:0])[1:] == (0.0, 0.0)


def test_gradients_of_terms_of_gaussians_agree_with_differences() -> None:
    values = 2 * pictures(6, 3).requires_grad_()
    for term in (
        position_hinge,
        scale_hinge,
        lambda x: spike_term(x[None], 0.5, 1.2),
        lambda x: cylinder_term(x, x.new_tensor([1.0, 1, 1]), 0.3, 0.2),
        lambda x: coverage_loss(x[None, ..., None], pictures(1, 6, 3, seed=3)),
    ):
        assert term(values) > 0
        assert torch.autograd.gradcheck(term, (values.detach().requires_grad_(),))


def test_at_the_origin_and_without_excess_gradients_are_finite() -> None:
    zero = torch.zeros(4, 3, requires_grad=True)
    total = position_hinge(zero) + scale_hinge(zero) + spike_term(zero[None], 0.1)
    total = total + cylinder_term(zero, torch.zeros(3), 1.0, 1.0)
    (gradient,) = torch.autograd.grad(total, zero)
    assert not gradient.any()
