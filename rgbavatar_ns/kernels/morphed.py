"""Morphed Gaussians drawn and trained without intermediate tensors, where a backend can.

The readable path is morphing, frames and activation in torch, then `rasterize`; this one gives the
same numbers and is only faster.
"""

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.functional import check_cameras
from rgbavatar_ns.kernels.registry import MorphedRenderer, PackedGaussians, choose
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
    tensor, bases = gaussians.position, gaussians.basis_position
    num_bases = 0 if bases is None else len(bases)
    if weights.shape[1] != num_bases or len(vertices) != len(weights):
        raise ValueError(
            f"weights are {list(weights.shape)} and vertices {list(vertices.shape)}. Pass "
            f"[B, {num_bases}] and [B, V, 3]."
        )
    if check_cameras(tensor, cameras) not in (1, len(weights)):
        return None
    return choose(backend, tensor.device, tensor.dtype).morphed_renderer(
        gaussians, weights, vertices, cameras
    )


def packed_gaussians(
    gaussians: MorphedGaussians, backend: str = "auto"
) -> PackedGaussians | None:
    """The chosen backend's copy for pictures one after another; None where it has none.

    Raises ValueError where there is no such backend.
    """
    tensor = gaussians.position
    return choose(backend, tensor.device, tensor.dtype).packed_gaussians(gaussians)
