"""The CUDA kernels behind torch's autograd."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.kernels.cuda.binning import Bins, Capacities, Images, blocks, camera_values
from rgbavatar_ns.kernels.cuda.launcher import Launcher
from rgbavatar_ns.kernels.cuda.morphed import CudaMorphedRenderer
from rgbavatar_ns.kernels.cuda.tiles import Tiles
from rgbavatar_ns.kernels.differentiable import (
    Drawn,
    Gradients,
    draw_differentiably,
    gaussian_inputs,
)
from rgbavatar_ns.kernels.registry import Backend
from rgbavatar_ns.kernels.types import (
    GaussianSet,
    MorphedGaussians,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)

_WORLD = ("means", "quats", "scales", "opacities", "colors")
_INPUTS = (*_WORLD, "screen_offset")


@dataclass
class _Request:
    """What of a rendering is not differentiated, and the outputs that carry no gradient."""

    launcher: Launcher
    capacities: Capacities
    cameras: PinholeCameras
    batch: int
    with_depth: bool
    with_visibility: bool
    depth: Tensor | None = None
    visibility: Tensor | None = None


def _world_values(gaussians: tuple[Tensor, ...]) -> dict[str, Any]:
    """The fields of `World` in arguments.h."""
    shared = {f"{name}_shared": int(len(t) == 1) for name, t in zip(_WORLD, gaussians)}
    return {**_named(gaussians), **shared}


def _named(inputs: Sequence[Tensor]) -> dict[str, Any]:
    """`gaussian_inputs` or their gradients by the names that arguments.h gives them."""
    return dict(zip_longest(_INPUTS, inputs))


def _tiles(request: _Request, gaussians: tuple[Tensor, ...]) -> Tiles:
    count = gaussians[0].shape[1]
    images = Images(request.batch, count, request.cameras.width, request.cameras.height)

    def project(bins: Any) -> None:
        request.launcher.launch(
            "project",
            (blocks(count, "kBlendThreads"), request.batch),
            frame=images.values(),
            cameras=camera_values(request.cameras),
            world=_world_values(gaussians),
            bins=bins,
        )

    bins = Bins(request.launcher, request.capacities, images, project)
    return Tiles(request.launcher, bins)


def _draw(
    request: _Request, gaussians: tuple[Tensor, ...], background: Tensor
) -> tuple[Tensor, Tensor, Gradients]:
    """See `kernels.differentiable.Draw`."""
    tiles = _tiles(request, gaussians)
    image, alpha, request.depth = tiles.draw(background, with_depth=request.with_depth)
    if request.with_visibility:
        request.visibility = tiles.average(None)[2]

    def gradients(
        gaussians: tuple[Tensor, ...],
        drawn: Drawn,
        image_grad: Tensor | None,
        alpha_grad: Tensor | None,
    ) -> list[Tensor]:
        slots = tiles.differentiate(drawn.image, drawn.alpha, image_grad, alpha_grad)
        filled = _gradients(request, tiles, gaussians, slots)
        return [grad.sum_to_size(t.shape) for grad, t in zip(filled, gaussians)]

    return image, alpha, gradients


def _gradients(
    request: _Request, tiles: Tiles, gaussians: tuple[Tensor, ...], slots: Tensor
) -> list[Tensor]:
    """The gradients of each image."""
    images = tiles.bins.images
    filled = [t.new_empty(images.batch, *t.shape[1:]) for t in gaussians]
    request.launcher.launch(
        "project_backward",
        (blocks(images.count, "kBlendThreads"), images.batch),
        frame=images.values(),
        cameras=camera_values(request.cameras),
        world=_world_values(gaussians),
        bins=tiles.bins.values(),
        slots=slots,
        **_named(filled),
    )
    return filled


class CudaBackend(Backend):
    """Runs float32 tensors on NVIDIA GPUs; the kernels are compiled at a GPU's first use."""

    def __init__(self) -> None:
        self._capacities: dict[torch.device, Capacities] = {}

    def launcher(self, device: torch.device) -> Launcher:
        """The device's launcher, made once."""
        return _cuda_launcher(device)

    def capacities(self, device: torch.device) -> Capacities:
        """The device's experience of how much room is needed."""
        return self._capacities.setdefault(device, Capacities())

    def unsupported_reason(self, device: torch.device, dtype: torch.dtype) -> str | None:
        """The reason, unless it is float32 on an NVIDIA GPU."""
        if device.type != "cuda" or dtype != torch.float32:
            return "it takes float32 tensors on NVIDIA GPUs"
        return None

    def _request(
        self,
        gaussians: GaussianSet,
        cameras: PinholeCameras,
        batch: int,
        with_depth: bool = False,
        with_visibility: bool = False,
    ) -> _Request:
        device = gaussians.means.device
        launcher, capacities = self.launcher(device), self.capacities(device)
        return _Request(launcher, capacities, cameras, batch, with_depth, with_visibility)

    def rasterize(
        self,
        gaussians: GaussianSet,
        cameras: PinholeCameras,
        background: Float[Tensor, "#B 3"],
        *,
        with_depth: bool,
        with_visibility: bool,
        screen_offset: Float[Tensor, "B N 2"] | None,
    ) -> RenderedBatch:
        """As `functional.rasterize`; waits once for the length of the tiles' lists."""
        inputs = gaussian_inputs(gaussians, screen_offset)
        batch = max(t.shape[0] for t in (*inputs, background, cameras.focal_px))
        request = self._request(gaussians, cameras, batch, with_depth, with_visibility)
        image, alpha = draw_differentiably(partial(_draw, request), *inputs, background)
        return RenderedBatch(image, alpha, request.depth, request.visibility)

    @torch.no_grad()
    def weighted_color_average(
        self, gaussians: GaussianSet, cameras: PinholeCameras, images: Float[Tensor, "#B H W C"]
    ) -> WeightedColors:
        """As `functional.weighted_color_average`."""
        inputs = tuple(tensor.detach().contiguous() for tensor in gaussian_inputs(gaussians))
        batch = max(t.shape[0] for t in (*inputs, images, cameras.focal_px))
        tiles = _tiles(self._request(gaussians, cameras, batch), inputs)
        weighted_sum, weight_sum, max_weight = tiles.average(images.detach().contiguous())
        assert weighted_sum is not None
        return WeightedColors(weighted_sum, weight_sum, max_weight)

    def morphed_renderer(
        self,
        gaussians: MorphedGaussians,
        weights: Float[Tensor, "B K"],
        vertices: Float[Tensor, "B V 3"],
        cameras: PinholeCameras,
    ) -> CudaMorphedRenderer:
        """As `morphed.morphed_renderer`."""
        device = weights.device
        return CudaMorphedRenderer(
            self.launcher(device), self.capacities(device), gaussians, weights, vertices, cameras
        )


@functools.cache
def _cuda_launcher(device: torch.device) -> Launcher:
    from rgbavatar_ns.kernels.cuda.driver import CudaLauncher

    return CudaLauncher(device)


def load() -> CudaBackend:
    """The backend; raises ImportError with the reason where there is no GPU for torch."""
    if not torch.cuda.is_available():
        built = torch.version.cuda is not None
        raise ImportError(
            f"torch, built for CUDA {torch.version.cuda}, sees no NVIDIA GPU; if there is one, its "
            "driver may be older (`nvidia-smi` shows its CUDA)"
            if built
            else "this build of torch is for CPUs; install a CUDA build for a GPU"
        )
    try:
        from rgbavatar_ns.kernels.cuda import driver as _driver  # noqa: F401
    except ImportError as error:
        raise ImportError(f"the CUDA bindings cannot be imported: {error}") from error
    return CudaBackend()
