"""What goes into and comes out of the rasterizer; every backend shares these types.

Conventions: cameras are OpenCV (x right, y down, z forward), lengths are metres, image
coordinates are pixels with the centre of the first pixel at (0.5, 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rgbavatar_ns.kernels.constants import NEAR_PLANE_M


class DeviceError(RuntimeError):
    """A GPU, its driver or its compiler cannot do what was asked; says why and what to do."""

    def __init__(self, cause: str, remedy: str) -> None:
        self.cause, self.remedy = cause, remedy
        super().__init__(f"{cause} {remedy}")


@dataclass(frozen=True)
class GaussianSet:
    """B sets of N world-space Gaussians; a leading 1 stands for all B sets.

    `quats_wxyz` need not be normalised; `scales` are standard deviations in metres;
    `opacities` lie in [0, 1]; `colors` are linear blending colours, usually in [0, 1]: beyond
    about a thousand they cost the gradients of Gaussians behind them their last digits.
    """

    means: Float[Tensor, "#B N 3"]
    quats_wxyz: Float[Tensor, "#B N 4"]
    scales: Float[Tensor, "#B N 3"]
    opacities: Float[Tensor, "#B N"]
    colors: Float[Tensor, "#B N 3"]


@dataclass(frozen=True)
class PinholeCameras:
    """C cameras of one image size: C is 1 (shared by the batch) or B."""

    world_to_camera: Float[Tensor, "C 4 4"]
    focal_px: Float[Tensor, "C 2"]
    principal_point_px: Float[Tensor, "C 2"]
    width: int
    height: int

    def to(self, target: torch.device | str | Tensor) -> "PinholeCameras":
        """The same cameras on a device, or like a tensor: on its device and of its dtype."""
        return PinholeCameras(
            self.world_to_camera.to(target),
            self.focal_px.to(target),
            self.principal_point_px.to(target),
            self.width,
            self.height,
        )

    def select(self, positions: Sequence[int]) -> "PinholeCameras":
        """The cameras at these positions, in this order."""
        chosen = list(positions)
        return PinholeCameras(
            self.world_to_camera[chosen],
            self.focal_px[chosen],
            self.principal_point_px[chosen],
            self.width,
            self.height,
        )

    def placed(self, points: Float[Tensor, "#B P 3"]) -> Float[Tensor, "B P 3"]:
        """Points of the world in the cameras' axes, metres."""
        pose = self.world_to_camera
        return points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]

    def project(self, points: Float[Tensor, "#B P 3"]) -> Float[Tensor, "B P 2"]:
        """Where points of the world are in the pictures, pixels.

        A point behind the near plane is projected as if it were on it: to a finite number, which is
        no place in the picture (`shows`).
        """
        placed = self.placed(points)
        per_metre = self.focal_px[:, None] / placed[..., 2:].clamp(min=NEAR_PLANE_M)
        return placed[..., :2] * per_metre + self.principal_point_px[:, None]

    def shows(self, points: Float[Tensor, "#B P 3"]) -> Bool[Tensor, "B P"]:
        """Which points are before the near plane and in the picture, seen or behind others."""
        place_px = self.project(points)
        size_px = place_px.new_tensor([self.width, self.height])
        inside = ((place_px >= 0) & (place_px <= size_px)).all(-1)
        return inside & (self.placed(points)[..., 2] >= NEAR_PLANE_M)

    def joined(self, others: "PinholeCameras") -> "PinholeCameras":
        """These cameras, then others of the same image size."""
        return PinholeCameras(
            torch.cat([self.world_to_camera, others.world_to_camera]),
            torch.cat([self.focal_px, others.focal_px]),
            torch.cat([self.principal_point_px, others.principal_point_px]),
            self.width,
            self.height,
        )


CAMERA_TENSORS = ("world_to_camera", "focal_px", "principal_point_px")
"""What cameras hold beside the image size."""


@dataclass(frozen=True)
class RenderedBatch:
    """B images; `depth` and `visibility` are there only when they were asked for.

    `depth` is the expected depth in metres along the camera's z (0 where nothing is seen);
    `visibility` is each Gaussian's largest blending weight (alpha times transmittance) over
    the pixels of its image. Both carry no gradient.
    """

    image: Float[Tensor, "B H W 3"]
    alpha: Float[Tensor, "B H W 1"]
    depth: Float[Tensor, "B H W 1"] | None = None
    visibility: Float[Tensor, "B N"] | None = None


@dataclass(frozen=True)
class WeightedColors:
    """Per-Gaussian sums over the pixels of each image, weighted by the blending weight w.

    `weighted_sum` = sum w I, `weight_sum` = sum w, `max_weight` = max w.
    """

    weighted_sum: Float[Tensor, "B N C"]
    weight_sum: Float[Tensor, "B N"]
    max_weight: Float[Tensor, "B N"]


SIGHT_SUMS = 5
"""Numbers that `FirstSight.sums` holds for each Gaussian."""
SIGHT_UNIT = 2.0**-32
"""What 1 stands for in `FirstSight.sums`."""


@dataclass
class FirstSight:
    """What a training step's pictures show of the Gaussians that wait for their first colour.

    The step adds to `sums`, for each Gaussian that is not `known`, counted colour (3) and counted
    weight over the pixels, and raises the last number to the largest weight. They begin at 0, in
    units of `SIGHT_UNIT`: whole numbers, whose sums are the same in any order. Only the first
    `num_images` pictures count. Counted is the weight times the picture's matte, or with
    `over_background` the weight, and the colour then that of the picture over its background. What
    no pixel shows with a weight above `threshold` may be passed over. A backend that knows the rows
    it filled without waiting for a device leaves them in `shown`, None at first.
    """

    known: Bool[Tensor, "N"]
    sums: Int[Tensor, "N 5"]
    num_images: int
    threshold: float = 0.0
    over_background: bool = False
    shown: list[int] | None = None


TANGENT_VARIANTS = ("normalized", "raw", "orthonormal")
"""The forms of a triangle's tangent frame, in the order of their numbers in compiled code."""


@dataclass(frozen=True)
class MorphedGaussians:
    """N Gaussians in the tangent frames of a mesh's triangles, with K bases (RGBAvatar, eq. 1).

    `basis_*` are None where K = 0. Scales are activated by exp, opacities by the sigmoid, colours
    are .5 + .282 f. `edges_to_frame` gives each triangle's T and B (rows) from its two edges;
    `triangle_of` names each Gaussian's triangle. With `rest_length` (the root of each triangle's
    area at rest) scales follow the triangles.
    """

    position: Float[Tensor, "N 3"]
    rotation_wxyz: Float[Tensor, "N 4"]
    color_feature: Float[Tensor, "N 3"]
    log_scale: Float[Tensor, "N 3"]
    opacity_logit: Float[Tensor, "N"]
    basis_position: Float[Tensor, "K N 3"] | None
    basis_rotation_wxyz: Float[Tensor, "K N 4"] | None
    basis_color_feature: Float[Tensor, "K N 3"] | None
    barycentric: Float[Tensor, "N 3"]
    triangle_of: Int[Tensor, "N"]
    triangle_vertices: Int[Tensor, "U 3"]
    edges_to_frame: Float[Tensor, "U 2 2"]
    rest_length: Float[Tensor, "U"] | None
    variant: Literal["normalized", "raw", "orthonormal"]


UPDATED_ATTRIBUTES = (
    "position",
    "rotation_wxyz",
    "color_feature",
    "log_scale",
    "opacity_logit",
)
"""What of morphed Gaussians is trained; the first three have bases."""
BASIS_ATTRIBUTES = ("basis_position", "basis_rotation_wxyz", "basis_color_feature")


@dataclass(frozen=True)
class MorphedGradient:
    """The gradient of what poses morphed Gaussians: `vertices` only when it was asked for."""

    weights: Float[Tensor, "B K"]
    vertices: Float[Tensor, "B V 3"] | None = None


@dataclass(frozen=True)
class AdamParameter:
    """A parameter with Adam's state, to be updated in place; `step` counts from 1, this one too."""

    value: Float[Tensor, "*shape"]
    first_moment: Float[Tensor, "*shape"]
    second_moment: Float[Tensor, "*shape"]
    learning_rate: float
    betas: tuple[float, float]
    epsilon: float
    step: int

    def step_numbers(self) -> tuple[float, float, float, float, float]:
        """The step as compiled code takes it, with the bias corrections folded in (AdamStep)."""
        beta1, beta2 = self.betas
        rate = self.learning_rate / (1 - beta1**self.step)
        return rate, (1 - beta2**self.step) ** -0.5, beta1, beta2, self.epsilon
