"""A prior for what was never seen: it lies on the person's surface, closed and plain.

How much each Gaussian was seen decides how far it may leave the place, shape and colour that its
surroundings suggest. Ours: Adam moves what is hardly seen as fast as everything else, so that
without it a head turned beyond its film shatters (the paper names the limit, not a remedy).
"""

import math

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.drawing.compositing import is_unfilmed
from rgbavatar_ns.kernels import PinholeCameras, weighted_color_average

Images = UInt8[Tensor, "B height width 4"] | Float[Tensor, "B height width 4"]

EVERY = 20
"""Steps between two looks at what was seen."""
_FIRST_STEP, _FIRST_PULL = 60, 160
"""Until the surface has closed everything is seen; then frames are looked at before any pull."""
_RATE = 0.3
"""Share of the way to the surface that an unseen Gaussian goes at a time."""
_FORGETS = 0.97
_SEEN_PX = 0.02
"""Pixels that a Gaussian covers in the frame that shows it best, at which it is half known."""
_CLEAR_PX = 0.1
"""Pixels from which its colour tells that of its surroundings."""
_SUNK = 1.25
"""How many of its widths a Gaussian's centre lies below the surface that it reaches to."""
_FLATNESS = math.log(0.25)
"""Logarithm of thickness over width: surfaces are made of discs."""
_CLOSED, _EMPTY = math.log(0.9 / 0.1), math.log(0.01 / 0.99)
_STIFFNESS, _REST, _ITERATIONS = 0.02, 1e-6, 30


class SurfacePrior(nn.Module):
    """Remembers how much each of N Gaussians was seen, and draws the unseen to the surface.

    Attributes:
        seen_px: pixels that each covered in the frame that showed it best, slowly forgotten.
        offset_m: how far the surface stands off the mesh at each, by the outlines of mattes.
        opacity_logit: of the surface: closed, but where mattes show background.
        begun: whether the surface has been measured.
    """

    seen_px: Float[Tensor, "N"]
    offset_m: Float[Tensor, "N"]
    opacity_logit: Float[Tensor, "N"]
    begun: Tensor

    def __init__(self, num_gaussians: int) -> None:
        super().__init__()
        self.register_buffer("seen_px", torch.zeros(num_gaussians))
        self.register_buffer("offset_m", torch.zeros(num_gaussians))
        self.register_buffer("opacity_logit", torch.full((num_gaussians,), _CLOSED))
        self.register_buffer("begun", torch.zeros((), dtype=torch.bool))
        self._field: tuple[torch.device, MeshField] | None = None
        self._has_begun = False

    @property
    def has_begun(self) -> bool:
        """Whether the surface has been measured; else nothing is drawn to it."""
        self._has_begun = self._has_begun or bool(self.begun)
        return self._has_begun

    def begin(
        self,
        avatar: Avatar,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        images_rgba: Images,
    ) -> None:
        """Measure the surface by these frames, and put a fresh avatar's Gaussians on it."""
        # Here, so that timing steps on a bare machine needs no OpenCV.
        from rgbavatar_ns.avatar.prior.outline import measure_outline

        field = self._mesh_field(avatar)
        outline = measure_outline(avatar, field, theta, cameras, _as_bytes(images_rgba))
        known = torch.stack([outline.offset_m, outline.empty], 1)
        offset_m, empty = field.at_gaussians(known).unbind(1)
        self.offset_m.copy_(offset_m - _SUNK * avatar.initial_scale_m())
        self.opacity_logit.copy_(torch.where(empty > 0.5, _EMPTY, _CLOSED))
        self.begun.fill_(True)
        with torch.no_grad():
            avatar.blendshapes.position[:, 2] = self.offset_m
            avatar.blendshapes.log_scale.copy_(_disc(avatar))
            avatar.blendshapes.opacity_logit.copy_(self.opacity_logit)

    def due(self, step: int) -> bool:
        """Whether `after_step` has something to do after this step, counted from 0."""
        return step >= _FIRST_STEP and (step + 1) % EVERY == 0 and self.has_begun

    @torch.no_grad()
    def after_step(
        self,
        avatar: Avatar,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
        images_rgba: Images,
        step: int,
        backend: str = "auto",
    ) -> None:
        """See what these frames show, and draw what none shows to the surface."""
        self.seen_px.mul_(_FORGETS)
        seen_px = _seen_px(avatar, theta, cameras, images_rgba, backend)
        torch.maximum(self.seen_px, seen_px, out=self.seen_px)
        if step < _FIRST_PULL:
            return
        shapes, field = avatar.blendshapes, self._mesh_field(avatar)
        clear = self.seen_px.square() / (self.seen_px.square() + _CLEAR_PX**2)
        told, confidence = field.of_gaussians(shapes.color_feature, clear)
        start, _ = field.of_gaussians(shapes.color_feature, torch.ones_like(clear))
        color = field.continued(
            told, confidence, start, stiffness=_STIFFNESS, rest=_REST, iterations=_ITERATIONS
        )
        pull = _RATE * _SEEN_PX / (self.seen_px + _SEEN_PX)
        place = torch.zeros_like(shapes.position)
        place[:, 2] = self.offset_m
        upright = torch.zeros_like(shapes.rotation_wxyz)
        upright[:, 0] = 1
        rest = {
            "position": place,
            "rotation_wxyz": upright,
            "log_scale": _disc(avatar),
            "opacity_logit": self.opacity_logit,
            "color_feature": field.at_gaussians(color),
        }
        for name, target in rest.items():
            value = getattr(shapes, name)
            value.lerp_(target, pull.view(-1, *[1] * (value.ndim - 1)))
        for name in ("basis_position", "basis_rotation_wxyz", "basis_color_feature"):
            if shapes.num_bases:
                getattr(shapes, name).mul_((1 - pull)[:, None])

    def _mesh_field(self, avatar: Avatar) -> MeshField:
        device = self.seen_px.device
        if self._field is None or self._field[0] != device:
            self._field = device, MeshField(avatar)
        return self._field[1]


def _disc(avatar: Avatar) -> Float[Tensor, "N 3"]:
    """The logarithms of the scales that a fresh Gaussian of the surface has."""
    log_scale = avatar.initial_scale_m().log()[:, None].repeat(1, 3)
    log_scale[:, 2] += _FLATNESS
    return log_scale


def _seen_px(
    avatar: Avatar,
    theta: Float[Tensor, "B H"],
    cameras: PinholeCameras,
    images_rgba: Images,
    backend: str,
) -> Float[Tensor, "N"]:
    """Filmed pixels that each Gaussian covers, by blending weight, in the best of the frames."""
    filmed = (~is_unfilmed(images_rgba)).to(avatar.identity)[..., None]
    renderer = avatar.renderer(theta, cameras, backend=backend)
    if renderer is not None:
        sums = renderer.weighted_color_average(filmed)
    else:
        sums = weighted_color_average(avatar.gaussians(theta), cameras, filmed, backend=backend)
    return sums.weighted_sum[..., 0].amax(0)


def _as_bytes(images_rgba: Images) -> UInt8[Tensor, "B height width 4"]:
    if images_rgba.dtype == torch.uint8:
        return images_rgba
    return (images_rgba.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
