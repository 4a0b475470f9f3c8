"""The backends and how one is chosen; another device's backend joins by one entry in `_LOADERS`."""

import functools
import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from rgbavatar_ns.kernels.posing import Posing, PosingParameters
from rgbavatar_ns.kernels.types import (
    AdamParameter,
    FirstSight,
    GaussianSet,
    MorphedGaussians,
    MorphedGradient,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)


@runtime_checkable
class MorphedRenderer(Protocol):
    """B posed sets of the same morphed Gaussians, projected and sorted; carries no autograd graph.

    Neither Gaussians, weights nor vertices may change before `update`.
    """

    def draw(
        self,
        background: Float[Tensor, "3"] | Float[Tensor, "#B 3"] | None = None,
        *,
        with_depth: bool = False,
        with_visibility: bool = False,
    ) -> RenderedBatch:
        """As `rasterize`, without gradients."""
        ...

    def draw_one(self, place: int) -> RenderedBatch:
        """The set at a place of the batch by itself, over black; ValueError where none is."""
        ...

    def weighted_color_average(self, images: Float[Tensor, "#B H W C"]) -> WeightedColors:
        """As `weighted_color_average`."""
        ...

    def forward_loss(
        self,
        images_rgba: UInt8[Tensor, "B H W 4"],
        background: Float[Tensor, "#B 3"],
        sight: FirstSight | None = None,
    ) -> Float[Tensor, ""]:
        """The mean absolute difference to straight-alpha images over the background.

        Pixels that are marked `UNFILMED_RGBA` differ by 0; the divisor is that of all pixels.
        `sight` is added to where it is given.
        """
        ...

    def backward_adam(
        self, parameters: Mapping[str, AdamParameter] | None, *, with_vertices: bool = False
    ) -> MorphedGradient:
        """Take one step of Adam by the gradient of the last forward_loss, in place.

        `parameters` holds one entry for each of the Gaussians' tensors, by its name; None leaves
        them all as they are. Returns the gradient of the weights and, if asked, of the vertices.
        """
        ...


@runtime_checkable
class DeviceRenderer(MorphedRenderer, Protocol):
    """A renderer whose training steps need nothing from the host, so that they can be recorded."""

    @property
    def overflowed(self) -> Int[Tensor, ""]:
        """1 where the last forward_loss found no room and updates change nothing, else 0.

        The same for `draw_at_once`, whose picture is then only background.
        """
        ...

    @property
    def needed(self) -> Int[Tensor, ""]:
        """How much room was needed, in units of `make_room`."""
        ...

    def read_later(self, numbers: Int[Tensor, " N"]) -> Callable[[], list[int] | None]:
        """What gives the present numbers once they are here, and None until then."""
        ...

    def make_room(self, needed: int) -> None:
        """Give later renderings of this kind at least so much room."""
        ...

    def draw_at_once(self, background: Float[Tensor, "#B 3"]) -> RenderedBatch:
        """As `draw`, without waiting for the room that it needs."""
        ...

    def forward_loss_of(
        self,
        images_rgba: UInt8[Tensor, "F H W 4"],
        image_of: Int[Tensor, " B"],
        background: Float[Tensor, "B 3"],
        sight: FirstSight | None = None,
    ) -> Float[Tensor, ""]:
        """As `forward_loss`, with each set's image chosen by its number.

        Of `images_rgba` the first `num_images` count for `sight`, in whichever sets they are.
        """
        ...

    def backward_adam_with(
        self, parameters: Mapping[str, AdamParameter], numbers: Float[Tensor, "A 10"]
    ) -> MorphedGradient:
        """As `backward_adam`, with `AdamParameter.step_numbers` read on the device.

        A row for each of UPDATED_ATTRIBUTES: the base's numbers, then its bases'.
        """
        ...

    def update_parameter(
        self, parameter: AdamParameter, gradient: Tensor, numbers: Float[Tensor, "10"]
    ) -> None:
        """Take the same step with any other parameter; none where it overflowed."""
        ...


@runtime_checkable
class PictureRenderer(Protocol):
    """One posed set of Gaussians, projected; for pictures alone."""

    def draw(
        self,
        background: Float[Tensor, "3"] | Float[Tensor, "1 3"] | None = None,
        *,
        with_depth: bool = False,
    ) -> RenderedBatch:
        """As `rasterize`, without gradients."""
        ...


@runtime_checkable
class PackedGaussians(Protocol):
    """A copy of morphed Gaussians for pictures one after another.

    Bases are in 16, 10 and 8 bits and what no picture shows is left out, so that pictures are those
    of the Gaussians to 1/512, but for single pixels where a Gaussian's edge falls to the other
    side. It does not follow when the Gaussians change, and holds their memory meanwhile.
    """

    @property
    def count(self) -> int:
        """How many Gaussians a picture can show."""
        ...

    @property
    def num_bytes(self) -> int:
        """The memory that the copy takes."""
        ...

    def renderer(
        self,
        weights: Float[Tensor, "1 K"],
        vertices: Float[Tensor, "1 V 3"],
        cameras: PinholeCameras,
    ) -> PictureRenderer:
        """Prepare one picture."""
        ...


@runtime_checkable
class Backend(Protocol):
    """What a rasterizer offers; shapes have been checked when its methods are called.

    Backends derive from it: what returns None here has a readable path in torch, which is taken
    where a backend has nothing faster.
    """

    def unsupported_reason(self, device: torch.device, dtype: torch.dtype) -> str | None:
        """Why tensors of this device and type cannot be taken; None if they can."""
        ...

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
        """As `functional.rasterize`."""
        ...

    def weighted_color_average(
        self, gaussians: GaussianSet, cameras: PinholeCameras, images: Float[Tensor, "#B H W C"]
    ) -> WeightedColors:
        """As `functional.weighted_color_average`."""
        ...

    def morphed_renderer(
        self,
        gaussians: MorphedGaussians,
        weights: Float[Tensor, "B K"],
        vertices: Float[Tensor, "B V 3"],
        cameras: PinholeCameras,
    ) -> MorphedRenderer | None:
        """As `morphed.morphed_renderer`; None where this backend has none."""
        return None

    def packed_gaussians(self, gaussians: MorphedGaussians) -> PackedGaussians | None:
        """As `morphed.packed_gaussians`; None where this backend has none."""
        return None

    def posing(self, parameters: PosingParameters) -> Posing | None:
        """As `morphed.posing_of`; None where this backend has none."""
        return None

    def mean_similarity(
        self,
        image: Float[Tensor, "B H W 3"],
        target: Float[Tensor, "B H W 3"],
        window: Float[Tensor, "11"],
        stabilizers: tuple[float, float],
        *,
        with_gradient: bool,
    ) -> tuple[Float[Tensor, "B"], Float[Tensor, "B H W 3"] | None] | None:
        """As `similarity.mean_similarity`; None where this backend has none."""
        return None

    def harmonic_colors(
        self, coefficients: Float[Tensor, "#B N C 3"], directions: Float[Tensor, "B N 3"]
    ) -> Float[Tensor, "B N 3"] | None:
        """As `harmonics.harmonic_colors`; None where this backend has none."""
        return None


# Name -> module with `load() -> Backend`, which raises ImportError with the reason; the order is
# the order of preference.
_LOADERS = {
    "cuda": "rgbavatar_ns.kernels.cuda.backend",
    "cpu": "rgbavatar_ns.kernels.cpu.backend",
    "reference": "rgbavatar_ns.kernels.reference_backend",
}


def install_cuda_bindings(cuda: str | None) -> str:
    """The line that brings bindings of a torch's CUDA ("13.0"), not of the newest there is."""
    version = "" if cuda is None else f"=={cuda.split('.')[0]}.*"
    return f'pip install "cuda-bindings{version}"'


def _remedy(name: str) -> str:
    if name == "cuda":
        return f"Install what is missing: {install_cuda_bindings(torch.version.cuda)}"
    return "Reinstall the package with a C++17 compiler."


@functools.cache
def _load(name: str) -> Backend | ImportError:
    try:
        return importlib.import_module(_LOADERS[name]).load()
    except ImportError as error:
        return error


def available_backends() -> tuple[str, ...]:
    """Names of the backends that can be used in this process, the preferred ones first."""
    return tuple(name for name in _LOADERS if not isinstance(_load(name), ImportError))


def unavailable_backends() -> dict[str, str]:
    """Why the others cannot be used, by their names."""
    errors = {name: _load(name) for name in _LOADERS}
    return {name: str(e) for name, e in errors.items() if isinstance(e, ImportError)}


def choose(name: str, device: torch.device, dtype: torch.dtype) -> Backend:
    """The named backend, or for "auto" the first that takes such tensors.

    Raises ValueError when there is none, with every backend's reason.
    """
    if name != "auto" and name not in _LOADERS:
        raise ValueError(
            f"There is no backend {name!r}. Pass 'auto' or one of {', '.join(_LOADERS)}."
        )
    refusals = []
    for candidate in _LOADERS if name == "auto" else (name,):
        backend = _load(candidate)
        if isinstance(backend, ImportError):
            if name == "auto" and device.type == candidate and dtype == torch.float32:
                _warn_of_slow_choice(candidate, str(backend))
            refusals.append(f"{candidate}: {backend}")
            continue
        unsupported_reason = backend.unsupported_reason(device, dtype)
        if unsupported_reason is None:
            return backend
        refusals.append(f"{candidate}: {unsupported_reason}")
    raise ValueError(
        f"No backend for {dtype} tensors on {device} ({'; '.join(refusals)}). "
        "Move the tensors, convert them, or pass backend='auto'."
    )


@functools.cache
def _warn_of_slow_choice(name: str, reason: str) -> None:
    warnings.warn(
        f"The rasterizer's {name} backend cannot be used ({reason}); rendering falls back to the "
        f"reference, which is many times slower. {_remedy(name)}",
        RuntimeWarning,
        stacklevel=4,
    )
