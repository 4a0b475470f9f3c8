"""What `gpu_check.py` asks of the CUDA backend's compiler and rasterizer: one function a question.

Each takes the place where kernels run and returns what it found. Scenes and avatars are those of
the tests, so that a failure here can be looked at there, by emulation.
"""

import dataclasses
import os
import tempfile
import time
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.bench.scenes import on_device
from rgbavatar_ns.kernels import weighted_color_average
from rgbavatar_ns.kernels.registry import choose
from tests.kernels.scenes import (
    ATTRIBUTES,
    Scene,
    random_scene,
    render_and_differentiate,
    settled_pixels,
    to,
)

MOST_VALUE_ERROR, MOST_GRADIENT_ERROR = 1e-4, 1e-3

_SCENES: dict[str, dict[str, Any]] = {
    "odd size": {},
    "wide": {"width": 83, "height": 17, "count": 120},
    "tall": {"width": 15, "height": 66, "count": 120},
    "a camera each": {"num_cameras": 3},
    "shared scales and opacities": {"shared": ("scales", "opacities")},
    "one set, three cameras": {"shared": ATTRIBUTES, "batch": 1, "num_cameras": 3},
    "many": {"width": 61, "height": 50, "count": 700},
}
_FEW_SCENES = ("odd size", "one set, three cameras")


@dataclass(frozen=True)
class Place:
    """Where the kernels run, and how thoroughly they are asked."""

    device: torch.device
    emulated: bool
    quick: bool

    @property
    def backend(self) -> Any:
        """The CUDA backend there."""
        return choose("cuda", self.device, torch.float32)

    def wait(self) -> None:
        """Until the GPU has done everything."""
        if not self.emulated:
            torch.cuda.synchronize(self.device)


@dataclass(frozen=True)
class Finding:
    """Whether all is well (None: not asked), in a line, and the figures."""

    passed: bool | None
    told: str
    figures: dict[str, Any] = field(default_factory=dict)


def compilation(place: Place) -> Finding:
    """Seconds to compile the kernels for this GPU, and to find them again."""
    from rgbavatar_ns.kernels.cuda.compiler import compile_kernels

    architecture = "sm_{}{}".format(*torch.cuda.get_device_capability(place.device))
    seconds, before = [], os.environ.get("RGBAVATAR_CACHE")
    code = b""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["RGBAVATAR_CACHE"] = folder
        try:
            for _ in range(2):
                start = time.perf_counter()
                code = compile_kernels(architecture)
                seconds.append(time.perf_counter() - start)
        finally:
            del os.environ["RGBAVATAR_CACHE"]
            if before is not None:
                os.environ["RGBAVATAR_CACHE"] = before
    start = time.perf_counter()
    place.backend.launcher(place.device)
    figures = {
        "architecture": architecture,
        "compile_s": seconds[0],
        "found_again_s": seconds[1],
        "first_use_s": time.perf_counter() - start,
        "bytes": len(code),
    }
    told = f"{architecture}: compiled in {seconds[0]:.2f} s, found again in {seconds[1]:.4f} s"
    return Finding(True, told, figures)


def agreement(place: Place) -> Finding:
    """Values, gradients and colour averages against the float64 reference."""
    few = place.emulated or place.quick
    rows = {}
    for name in _FEW_SCENES if few else _SCENES:
        for seed in range(1 if few else 3):
            rows[f"{name}, seed {seed}"] = _scene_errors(
                random_scene(seed, **_SCENES[name]), place.device
            )
    value, gradient, average = (
        float(torch.tensor([row[kind] for row in rows.values()]).max())
        for kind in ("value", "gradient", "average")
    )
    passed = value < MOST_VALUE_ERROR and gradient < MOST_GRADIENT_ERROR and average <= 1
    told = (
        f"{len(rows)} scenes: values within {value:.1e}, gradients within {gradient:.1e} relative "
        f"L2, colour averages at {average:.2f} of what is allowed"
    )
    return Finding(passed, told, {"scenes": rows})


def _scene_errors(scene: Scene, device: torch.device) -> dict[str, Any]:
    """Of values the largest, of gradients the relative L2; of averages a share of the allowed.

    Where rounding decides whether an alpha is cut, pixels are left out, and an average may differ
    by the cut. A gradient that vanishes is held against what it is a sum of.
    """
    settled = settled_pixels(scene)
    mask = settled.double()
    wanted, wanted_grads = render_and_differentiate(scene, torch.float64, "reference", mask)
    there = dataclasses.replace(
        scene,
        gaussians=on_device(scene.gaussians, device),
        cameras=on_device(scene.cameras, device),
        **{n: getattr(scene, n).to(device) for n in ("background", "image_grad", "alpha_grad")},
    )
    got, grads = render_and_differentiate(there, torch.float32, "cuda", mask.to(device))
    values = [
        ((getattr(got, name).cpu() - getattr(wanted, name)) * mask).abs().max()
        for name in ("image", "alpha")
    ]
    floors = {
        "quats_wxyz": (scene.gaussians.scales * wanted_grads["scales"]).norm(),
        "background": 1e-3 * (mask * scene.image_grad).abs().sum(),
    }
    relative = {
        name: float((grads[name].cpu() - right).norm() / (right.norm() + floors.get(name, 1e-12)))
        for name, right in wanted_grads.items()
    }
    return {
        "value": float(torch.stack(values).max()),
        "gradient": float(torch.tensor(list(relative.values())).max()),
        "average": _average_error(scene, there, ~settled),
        "gradients": relative,
    }


def _average_error(scene: Scene, there: Scene, unsettled: Tensor) -> float:
    """The largest error of a weighted colour average, as a share of what rounding allows."""
    images = scene.image_grad.sigmoid()
    wanted = weighted_color_average(scene.gaussians, scene.cameras, images, backend="reference")
    got = weighted_color_average(
        to(there.gaussians, torch.float32),
        to(there.cameras, torch.float32),
        images.to(there.background.device, torch.float32),
        backend="cuda",
    )
    allowed = MOST_VALUE_ERROR * wanted.weight_sum + unsettled.sum() / 255 + 1e-5
    errors = [
        (got.weight_sum.cpu() - wanted.weight_sum).abs() / allowed,
        ((got.weighted_sum.cpu() - wanted.weighted_sum).abs() / allowed[..., None]).amax(-1),
        (got.max_weight.cpu() - wanted.max_weight).abs() / (1 / 255 + MOST_VALUE_ERROR),
    ]
    return float(torch.stack(errors).max())
