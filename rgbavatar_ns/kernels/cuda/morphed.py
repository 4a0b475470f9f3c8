"""Morphed Gaussians drawn and trained on a GPU."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from rgbavatar_ns.kernels.checks import check_average_images, check_sight, check_target_images
from rgbavatar_ns.kernels.cuda.binning import Bins, Capacities, Images, blocks, camera_values
from rgbavatar_ns.kernels.cuda.launcher import Launcher
from rgbavatar_ns.kernels.cuda.source import constants
from rgbavatar_ns.kernels.cuda.tiles import Tiles
from rgbavatar_ns.kernels.functional import checked_background
from rgbavatar_ns.kernels.types import (
    TANGENT_VARIANTS,
    UPDATED_ATTRIBUTES,
    AdamParameter,
    FirstSight,
    MorphedGaussians,
    MorphedGradient,
    PinholeCameras,
    RenderedBatch,
    WeightedColors,
)

_SHORT = dict(
    zip(UPDATED_ATTRIBUTES, ("position", "rotation", "color", "log_scale", "opacity_logit"))
)
"""Each attribute's name in arguments.h."""
_BLENDED = UPDATED_ATTRIBUTES[:3]
"""What the bases change."""


class CudaMorphedRenderer:
    """See `kernels.morphed.MorphedRenderer`."""

    def __init__(
        self,
        launcher: Launcher,
        capacities: Capacities,
        gaussians: MorphedGaussians,
        weights: Float[Tensor, "B K"],
        vertices: Float[Tensor, "B V 3"],
        cameras: PinholeCameras,
    ) -> None:
        self._launcher, self._cameras = launcher, cameras
        self._weights = weights.detach().contiguous()
        self._values = _morphed_values(gaussians, self._weights, vertices.detach().contiguous())
        self._images = Images(len(weights), len(gaussians.position), cameras.width, cameras.height)
        self._slots: Tensor | None = None
        self._launch_by_triangle("frames")
        if self._images.count:
            self._morph()
        bins = Bins(
            launcher, capacities, self._images, lambda bins: self._launch("blend", bins=bins)
        )
        self._tiles = Tiles(launcher, bins)

    def _launch(self, kernel: str, **values: Any) -> None:
        """Start a kernel by Gaussians and images."""
        images = self._images
        self._launcher.launch(
            kernel,
            (blocks(images.count, "kBlendThreads"), images.batch),
            frame=images.values(),
            cameras=camera_values(self._cameras),
            blended=self._values,
            **values,
        )

    @property
    def _weights_bytes(self) -> int:
        """Shared memory for the weights, images padded to fours."""
        return 4 * (-(-len(self._weights) // 4) * 4) * self._weights.shape[1]

    def _morph(self) -> None:
        widest = max(self._values[f"tangent_{_SHORT[name]}"][0].numel() for name in _BLENDED)
        self._launcher.launch(
            "morph",
            (blocks(widest, "kTileThreads"), len(_BLENDED)),
            self._weights_bytes,
            frame=self._images.values(),
            blended=self._values,
        )

    def _launch_by_triangle(self, kernel: str, **values: Any) -> None:
        self._launcher.launch(
            kernel,
            (blocks(self._values["triangles"], "kBlendThreads"), self._images.batch),
            frame=self._images.values(),
            blended=self._values,
            **values,
        )

    @property
    def overflowed(self) -> Int[Tensor, ""]:
        """1 where the last forward_loss found no room and updates change nothing, else 0."""
        return self._tiles.bins.status[constants()["kOverflow"]]

    @property
    def needed(self) -> Int[Tensor, ""]:
        """How many slots were needed, which are never fewer than the entries."""
        return self._tiles.bins.status[constants()["kSlotsNeeded"]]

    def read_later(self, numbers: Int[Tensor, " N"]) -> Callable[[], list[int] | None]:
        """See `Launcher`."""
        return self._launcher.read_later(numbers)

    def make_room(self, needed: int) -> None:
        """Give later renderings of this kind room for at least so many."""
        self._tiles.bins.make_room(needed)

    def draw(
        self,
        background: Float[Tensor, "3"] | Float[Tensor, "#B 3"] | None = None,
        *,
        with_depth: bool = False,
        with_visibility: bool = False,
    ) -> RenderedBatch:
        """As `rasterize`, without gradients."""
        background = checked_background(self._weights, background, self._images.batch)
        image, alpha, depth = self._tiles.draw(background.detach(), with_depth=with_depth)
        visibility = self._tiles.average(None)[2] if with_visibility else None
        return RenderedBatch(image, alpha, depth, visibility)

    def draw_one(self, place: int) -> RenderedBatch:
        """The set at a place of the batch by itself, over black."""
        if not 0 <= place < self._images.batch:
            raise ValueError(f"There is no set {place} among {self._images.batch}.")
        every, one = self.draw(), slice(place, place + 1)
        return RenderedBatch(every.image[one], every.alpha[one])

    def draw_at_once(self, background: Float[Tensor, "#B 3"]) -> RenderedBatch:
        """As `draw`, without waiting for the room that it needs; see `overflowed`."""
        image, alpha, _ = self._tiles.draw(background, with_depth=False, checked=False)
        return RenderedBatch(image, alpha)

    def weighted_color_average(self, images: Float[Tensor, "#B H W C"]) -> WeightedColors:
        """As `weighted_color_average`."""
        check_average_images(images, self._weights, self._cameras)
        weighted_sum, weight_sum, max_weight = self._tiles.average(images.detach().contiguous())
        assert weighted_sum is not None
        return WeightedColors(weighted_sum, weight_sum, max_weight)

    def forward_loss(
        self,
        images_rgba: UInt8[Tensor, "B H W 4"],
        background: Float[Tensor, "#B 3"],
        sight: FirstSight | None = None,
    ) -> Float[Tensor, ""]:
        """The mean absolute difference to straight-alpha images over the background.

        Pixels that are marked `UNFILMED_RGBA` differ by 0; the divisor is that of all pixels.
        """
        check_target_images(images_rgba, self._images.batch, self._cameras)
        background = checked_background(self._weights, background, self._images.batch)
        if sight is not None:
            check_sight(sight, self._images.count, self._weights)
        loss, self._slots = self._tiles.train(
            images_rgba.contiguous(), None, background.detach(), sight
        )
        return loss

    def forward_loss_of(
        self,
        images_rgba: UInt8[Tensor, "F H W 4"],
        image_of: Int[Tensor, " B"],
        background: Float[Tensor, "B 3"],
        sight: FirstSight | None = None,
    ) -> Float[Tensor, ""]:
        """As `forward_loss`, with images chosen on the device: nothing is copied or waited for."""
        loss, self._slots = self._tiles.train(images_rgba, image_of, background, sight)
        return loss

    def backward_adam(
        self, parameters: Mapping[str, AdamParameter] | None, *, with_vertices: bool = False
    ) -> MorphedGradient:
        """Take one step of Adam, or none, by the gradient of the last forward_loss."""
        numbers = None
        if parameters is not None:
            rows = [
                _numbers(parameters[name]) + _numbers(parameters.get(f"basis_{name}"))
                for name in UPDATED_ATTRIBUTES
            ]
            numbers = torch.tensor(rows).to(self._launcher.device, non_blocking=True)
        return self._updated(parameters, numbers, with_vertices)

    def backward_adam_with(
        self, parameters: Mapping[str, AdamParameter], numbers: Float[Tensor, "A 10"]
    ) -> MorphedGradient:
        """As `backward_adam`, with `AdamParameter.step_numbers` read on the device."""
        return self._updated(parameters, numbers, False)

    def update_parameter(
        self, parameter: AdamParameter, gradient: Tensor, numbers: Float[Tensor, "10"]
    ) -> None:
        """Take the same step with any other parameter; none where it overflowed."""
        flat = gradient.reshape(1, -1).contiguous()
        self._update([_columns(flat, parameter, numbers)], batch=1)

    def _updated(
        self,
        parameters: Mapping[str, AdamParameter] | None,
        numbers: Tensor | None,
        with_vertices: bool,
    ) -> MorphedGradient:
        if self._slots is None:
            raise ValueError("There is no gradient yet. Call forward_loss() first.")
        if self._images.count == 0:
            return self._of_nobody(with_vertices)
        gradients = self._differentiate(with_vertices)
        together = []
        for row, name in enumerate(UPDATED_ATTRIBUTES):
            gradient, base, basis = gradients[_SHORT[name]], None, None
            if parameters is not None:
                base, basis = parameters[name], parameters.get(f"basis_{name}")
            values = _columns(gradient, base, None if numbers is None else numbers[row])
            bases = self._values[f"basis_{_SHORT[name]}"] if name in _BLENDED else None
            if bases is not None:
                values |= _bases(bases, basis)
            together.append(values)
        weights = self._update_bases(together)
        self._slots = None  # the parameters are others now
        vertices = self._vertex_gradient(gradients["carried"]) if with_vertices else None
        return MorphedGradient(weights, vertices)

    def _of_nobody(self, with_vertices: bool) -> MorphedGradient:
        """Without Gaussians nothing has a gradient, and there is nothing to launch."""
        self._slots = None
        vertices = torch.zeros_like(self._values["vertices"]) if with_vertices else None
        return MorphedGradient(torch.zeros_like(self._weights), vertices)

    def _differentiate(self, with_vertices: bool) -> dict[str, Tensor]:
        """The gradients of each image by name."""
        size = (self._images.batch, self._images.count)
        new = self._weights.new_empty
        widths = {"position": 3, "rotation": 4, "color": 3, "log_scale": 3, "opacity_logit": 1}
        gradients = {name: new(*size, width) for name, width in widths.items()}
        if with_vertices:
            gradients["carried"] = new(*size, constants()["kCarriedFloats"])
        self._launch(
            "blend_backward",
            bins=self._tiles.bins.values(),
            slots=self._slots,
            **({"carried": None} | gradients),
        )
        return gradients

    def _update_bases(self, together: Sequence[dict[str, Any]]) -> Tensor:
        """One step for all; the gradient of the weights [B, K]."""
        blended = [values for values in together if values["bases"]]
        counts = [blocks(values["columns"], "kTileThreads") for values in blended]
        sums = self._weights.new_empty(sum(counts), *self._weights.shape)
        for values, part in zip(blended, sums.split(counts)):
            values["weight_sums"] = part
        self._update(together, batch=self._images.batch)
        return sums.sum(0)

    def _update(self, together: Sequence[dict[str, Any]], *, batch: int) -> None:
        """One step of Adam for some parameters and their bases."""
        places = constants()["kUpdatedTogether"]
        assert len(together) <= places
        rest = [_NO_COLUMNS] * (places - len(together))
        most = max(values["columns"] for values in together)
        self._launcher.launch(
            "update",
            (blocks(most, "kTileThreads"), len(together)),
            self._weights_bytes,
            batch=batch,
            weights=self._weights,
            status=self._tiles.bins.status,
            **{f"columns{i}": values for i, values in enumerate([*together, *rest])},
        )

    def _vertex_gradient(self, carried: Tensor) -> Tensor:
        """Gradients of the frames' parts, then of the corners, then of the vertices."""
        batch, triangles = self._images.batch, self._values["triangles"]
        d_mean, d_quat, d_ratio = carried[..., :3], carried[..., 3:7], carried[..., 7:8]
        position, along = carried[..., 8:11], self._values["barycentric"]
        rows = torch.cat(
            [
                (d_mean[..., :, None] * position[..., None, :]).flatten(-2),
                d_quat,
                d_mean,
                d_mean * along[:, 1:2],
                d_mean * along[:, 2:3],
                d_ratio,
                torch.zeros_like(d_ratio),
            ],
            dim=-1,
        )
        frames = rows.new_zeros(batch, triangles, constants()["kFrameFloats"])
        frames.index_add_(1, self._values["triangle_of"], rows)
        corners = rows.new_empty(batch, triangles, 3, 3)
        self._launch_by_triangle("frames_backward", frame_gradient=frames, corner_gradient=corners)
        vertices = torch.zeros_like(self._values["vertices"])
        return vertices.index_add_(
            1, self._values["triangle_vertices"].flatten(), corners.flatten(1, 2)
        )


def _morphed_values(
    gaussians: MorphedGaussians, weights: Tensor, vertices: Tensor
) -> dict[str, Any]:
    """The fields of `Morphed` in arguments.h."""
    tensors = {
        name: None if value is None else value.detach().contiguous()
        for name, value in vars(gaussians).items()
        if name != "variant"
    }
    edges = tensors["edges_to_frame"]
    assert edges is not None
    triangles = len(edges)
    return {
        "weights": weights,
        **{short: tensors[name] for name, short in _SHORT.items()},
        **{f"basis_{_SHORT[name]}": tensors[f"basis_{name}"] for name in _BLENDED},
        "barycentric": tensors["barycentric"],
        "triangle_of": tensors["triangle_of"],
        "triangle_vertices": tensors["triangle_vertices"],
        "edges_to_frame": edges,
        "rest_length": tensors["rest_length"],
        "vertices": vertices,
        "frames": weights.new_empty(len(weights), triangles, constants()["kFrameFloats"]),
        **{
            f"tangent_{_SHORT[name]}": weights.new_empty(
                len(weights), *getattr(gaussians, name).shape
            )
            for name in _BLENDED
        },
        "bases": weights.shape[1],
        "triangles": triangles,
        "vertex_count": vertices.shape[1],
        "variant": TANGENT_VARIANTS.index(gaussians.variant),
    }


_NO_COLUMNS: dict[str, Any] = {
    **{"columns": 0, "bases": 0, "gradient": None, "numbers": None, "weight_sums": None},
    **{"base": None, "base_first": None, "base_second": None},
    **{"basis": None, "basis_first": None, "basis_second": None},
}
"""The fields of `Columns` in arguments.h, of no parameter."""


def _columns(
    gradient: Tensor, base: AdamParameter | None, numbers: Tensor | None
) -> dict[str, Any]:
    """A parameter with its gradients [B, ...], to be updated where it is given."""
    values = _NO_COLUMNS | {"columns": gradient[0].numel(), "gradient": gradient}
    return values | {"numbers": numbers} | _moving("base", base)


def _bases(bases: Tensor, state: AdamParameter | None) -> dict[str, Any]:
    return {"bases": len(bases)} | _moving("basis", state) | {"basis": bases}


def _moving(name: str, state: AdamParameter | None) -> dict[str, Tensor]:
    if state is None:
        return {}
    moments = {f"{name}_first": state.first_moment, f"{name}_second": state.second_moment}
    return {name: state.value.detach()} | moments


def _numbers(parameter: AdamParameter | None) -> tuple[float, ...]:
    return (0.0,) * 5 if parameter is None else parameter.step_numbers()
