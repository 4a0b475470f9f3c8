"""Morphed Gaussians drawn and trained without intermediate tensors, where a backend can.

The readable path is morphing, frames and activation in torch, then `rasterize`; this one gives the
same numbers and is only faster.
"""

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.checks import check_vertices
from rgbavatar_ns.kernels.functional import check_cameras
from rgbavatar_ns.kernels.posing import Posing, PosingParameters
from rgbavatar_ns.kernels.registry import (
    MorphedRenderer,
    PackedGaussians,
    PictureRenderer,
    choose,
)
from rgbavatar_ns.kernels.types import MorphedGaussians, PinholeCameras


def morphed_renderer(
    gaussians: MorphedGaussians,
    weights: Float[Tensor, "B K"],
    vertices: Float[Tensor, "B V 3"],
    cameras: PinholeCameras,
    backend: str = "auto",
) -> MorphedRenderer | None:
    """The chosen backend's renderer for one batch; None where it has none or cannot take this.

    Raises ValueError where there is no such backend, for weights and vertices that do not fit, and
    for cameras as `rasterize`.
    """
    if _num_cameras(gaussians, weights, vertices, cameras) not in (1, len(weights)):
        return None
    tensor = gaussians.position
    return choose(backend, tensor.device, tensor.dtype).morphed_renderer(
        gaussians, weights, vertices, cameras
    )


def packed_gaussians(gaussians: MorphedGaussians, backend: str = "auto") -> PackedGaussians | None:
    """The chosen backend's copy for pictures one after another; None where it has none.

    Raises ValueError where there is no such backend.
    """
    tensor = gaussians.position
    return choose(backend, tensor.device, tensor.dtype).packed_gaussians(gaussians)


def posing_of(parameters: PosingParameters, backend: str = "auto") -> Posing | None:
    """The chosen backend's way from theta to weights and vertices; None where it has none.

    Raises ValueError where there is no such backend.
    """
    tensor = parameters.rest
    return choose(backend, tensor.device, tensor.dtype).posing(parameters)


def picture_renderer(
    packed: PackedGaussians,
    gaussians: MorphedGaussians,
    weights: Float[Tensor, "1 K"],
    vertices: Float[Tensor, "1 V 3"],
    cameras: PinholeCameras,
) -> PictureRenderer:
    """One picture of Gaussians that have been packed; raises ValueError as `morphed_renderer`."""
    if _num_cameras(gaussians, weights, vertices, cameras) != 1 or len(weights) != 1:
        raise ValueError("Packed Gaussians are drawn one picture at a time. Pass one camera.")
    return packed.renderer(weights, vertices, cameras)


def _num_cameras(
    gaussians: MorphedGaussians,
    weights: Float[Tensor, "B K"],
    vertices: Float[Tensor, "B V 3"],
    cameras: PinholeCameras,
) -> int:
    """How many cameras there are; raises ValueError where the parts do not fit one another."""
    bases = gaussians.basis_position
    num_bases = 0 if bases is None else len(bases)
    if weights.shape[1] != num_bases or len(vertices) != len(weights):
        raise ValueError(
            f"weights are {list(weights.shape)} and vertices {list(vertices.shape)}. Pass "
            f"[B, {num_bases}] and [B, V, 3]."
        )
    if len(weights) == 0:
        raise ValueError("weights: leading dimension 0. Pass at least 1: there is no empty batch.")
    check_vertices(gaussians.triangle_vertices, vertices)
    return check_cameras(gaussians.position, cameras)
