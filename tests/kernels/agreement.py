"""Agreement of a float32 backend with the float64 reference: values and gradients."""

from dataclasses import dataclass

import torch
from torch import Tensor

from rgbavatar_ns.kernels import RenderedBatch
from tests.kernels.scenes import Scene, render_and_differentiate, settled_pixels


@dataclass(frozen=True)
class Expected:
    """A scene, its pixels [B, H, W, 1] that are compared (1 or 0), and the reference's results."""

    scene: Scene
    mask: Tensor
    rendered: RenderedBatch
    gradients: dict[str, Tensor]


def expect(scene: Scene, least_settled: float = 0.5) -> Expected:
    """What the float64 reference gives where rounding does not decide about an alpha."""
    mask = settled_pixels(scene).double()
    assert mask.mean() > least_settled
    return Expected(scene, mask, *render_and_differentiate(scene, torch.float64, "reference", mask))


def _floors(expected: Expected) -> dict[str, Tensor]:
    """What rounding errors are compared with where a gradient vanishes.

    Turning a Gaussian of three equal scales changes nothing, but each scale's part of that
    does. The background's gradient is a sum of 1 - alpha, which has an absolute error.
    """
    shape = expected.scene.gaussians.scales * expected.gradients["scales"]
    shown = (expected.mask * expected.scene.image_grad).abs().sum()
    return {"quats_wxyz": shape.norm(), "background": 1e-3 * shown}


def assert_agrees(
    expected: Expected,
    backend: str,
    *,
    value_error: float = 1e-4,
    gradient_error: float = 1e-3,
    attributes: tuple[str, ...] | None = None,
    device: str = "cpu",
) -> None:
    """Largest error of image and alpha, and relative L2 error of these (or all) inputs' gradients.

    The others' gradients must be finite.
    """
    mask, rendered = expected.mask, expected.rendered
    got, grads = render_and_differentiate(expected.scene, torch.float32, backend, mask, device)
    for name in ("image", "alpha"):
        value, wanted = getattr(got, name), getattr(rendered, name)
        assert torch.isfinite(value).all()
        assert ((value - wanted) * mask).abs().max() < value_error, name
    seen = mask * (rendered.alpha > 0.01)
    assert got.depth is not None
    assert rendered.depth is not None
    assert ((got.depth - rendered.depth) * seen).abs().max() <= 1e-3 * rendered.depth.max()
    assert got.visibility is not None
    assert rendered.visibility is not None
    # A cut pixel can raise the largest weight by the cut itself, no more.
    error = (got.visibility - rendered.visibility).abs()
    assert error.numel() == 0 or error.max() < 1 / 255 + value_error
    assert all(torch.isfinite(gradient).all() for gradient in grads.values())
    floors = _floors(expected)
    for attribute in attributes or expected.gradients:
        wanted = expected.gradients[attribute]
        error = (grads[attribute] - wanted).norm()
        allowed = gradient_error * (wanted.norm() + floors.get(attribute, 0) + 1e-12)
        assert error <= allowed, f"{attribute}: {float(error)} > {float(allowed)}"
