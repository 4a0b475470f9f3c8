"""Views that nobody filmed: nothing beside the person's outline, and within it no hole, no noise.

A picture cannot tell how deep a Gaussian lies. Seen from elsewhere, what lies wrong stands beside
the head, where the surface says that there is nothing. Within the outline the avatar is asked for
its own picture, closed and smoothed: what the film shows withstands, what it left open follows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.orbit import head_centre, orbit
from rgbavatar_ns.avatar.prior.mesh_field import Outline, body_vertices
from rgbavatar_ns.head import turn_seen
from rgbavatar_ns.head.surface import vertex_normals
from rgbavatar_ns.kernels import DeviceRenderer, PinholeCameras, RenderedBatch
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA

TURNS_DEGREES = (
    *(
        (sign * yaw, lean * pitch)
        for yaw, pitch in ((15, 8), (40, 12), (22, 8), (60, 12), (30, 10), (50, 12))
        for sign in (1, -1)
        for lean in (1, -1)
    ),
    *((0, pitch) for pitch in (20, -20, 32, -32)),
)
"""(yaw, pitch) away from each frame's own view."""
NUM_VIEWS = len(TURNS_DEGREES)
_JAWS_RAD = (0.0, 0.3, 0.0, 0.15)
"""How far the mouth is opened, at least, in one view after the other: its inside is the part of a
face that films show least."""
_FRAMES_A_VIEW = 40
"""Frames trained on for each view. Ours: one in 20 leaves less noise, one in 60 more detail."""
_BORDER_PX = 1
"""The outline is soft: so wide a rim within it is left alone."""
_COLLAR_M, _AROUND_COLLAR_M = (-0.06, 0.05), 0.02
"""Heights above a neck's foot between which it has a collar, and how far around that a view knows
nothing: clothes stand off there less evenly than hair, and it would cut a slit into them. Ours;
around all clothes it left more fog before the chest."""
_TURNING_DEGREES = 40.0
"""A head that turns or nods by so much in all is seen from enough sides for itself."""
_STRANDED = 0.05
"""Contrast of hair from which all of its light counts as strands."""
_HAIRLINE = 1 / 128
"""Standard deviation of the border of hair, a share of the picture's width."""
_CLEAR_DEGREES = 5.0
"""How far a view lies beyond what was filmed, at least."""


@dataclass(frozen=True)
class ViewedFrames:
    """What views are trained on; where nothing is known, pixels are unfilmed."""

    theta: Float[Tensor, "W H"]
    cameras: PinholeCameras
    images_rgba: UInt8[Tensor, "W height width 4"]


class VirtualViews(nn.Module):
    """Frames of the film seen from elsewhere, and how far the film itself goes.

    Attributes:
        surface_m: how far the person stands off each of V vertices.
        empty: share of the frames that show background at each vertex.
        goes_on_below: whether the film shows the person below the mesh.
        hair_contrast: of strands of hair, as the film shows it; 0 for none.
        theta: of the W views, some with an open mouth, whose cameras are held by their parts.
        turns_degrees: yaw, pitch and roll of the head in each view.
        filmed_low_degrees: the lowest turns that the film has shown so far; "high": the highest.
    """

    surface_m: Float[Tensor, "V"]
    empty: Float[Tensor, "V"]
    goes_on_below: Tensor
    hair_contrast: Float[Tensor, ""]
    theta: Float[Tensor, "W H"]
    world_to_camera: Float[Tensor, "W 4 4"]
    focal_px: Float[Tensor, "W 2"]
    principal_point_px: Float[Tensor, "W 2"]
    turns_degrees: Float[Tensor, "W 3"]
    size_px: Tensor
    filmed_low_degrees: Float[Tensor, "3"]
    filmed_high_degrees: Float[Tensor, "3"]

    def __init__(self, num_vertices: int, theta_size: int) -> None:
        super().__init__()
        count = NUM_VIEWS
        self.register_buffer("surface_m", torch.zeros(num_vertices))
        self.register_buffer("empty", torch.zeros(num_vertices))
        self.register_buffer("goes_on_below", torch.zeros((), dtype=torch.bool))
        self.register_buffer("hair_contrast", torch.zeros(()))
        self.register_buffer("theta", torch.zeros(count, theta_size))
        self.register_buffer("world_to_camera", torch.eye(4).repeat(count, 1, 1))
        self.register_buffer("focal_px", torch.ones(count, 2))
        self.register_buffer("principal_point_px", torch.zeros(count, 2))
        self.register_buffer("turns_degrees", torch.zeros(count, 3))
        self.register_buffer("size_px", torch.zeros(2, dtype=torch.int64))
        self.register_buffer("filmed_low_degrees", torch.full((3,), torch.inf))
        self.register_buffer("filmed_high_degrees", torch.full((3,), -torch.inf))
        self._drawn: dict[int, _Mask] = {}
        self._beyond: list[int] | None = None
        self._size: tuple[int, int] | None = None
        self.register_load_state_dict_post_hook(lambda module, _: module._forget())

    def _forget(self) -> None:
        """Drop what follows from the state."""
        self._drawn, self._beyond, self._size = {}, None, None

    @torch.no_grad()
    def begin(
        self,
        avatar: Avatar,
        outline: Outline,
        theta: Float[Tensor, "B H"],
        cameras: PinholeCameras,
    ) -> None:
        """Turn around these frames; `outline` says where the person's surface is."""
        count, shared = NUM_VIEWS, len(cameras.focal_px) == 1
        frames = [k % len(theta) for k in range(count)]
        theta = theta[frames].cpu().float()
        before = cameras.to("cpu").select([0] * count if shared else frames)
        yaw, pitch = torch.tensor(TURNS_DEGREES).to(before.world_to_camera).unbind(1)
        views = orbit(before, head_centre(avatar, theta).to(yaw), yaw, pitch)
        jaw = theta[:, avatar.layout.slice("jaw").start]
        opened = torch.tensor(_JAWS_RAD).repeat(count // len(_JAWS_RAD) + 1)[:count]
        jaw.copy_(torch.maximum(jaw, opened))
        self.surface_m.copy_(outline.offset_m)
        self.empty.copy_(outline.empty)
        self.goes_on_below.fill_(outline.goes_on_below)
        self.hair_contrast.fill_(outline.hair_contrast)
        self.theta.copy_(theta)
        self.world_to_camera.copy_(views.world_to_camera)
        self.focal_px.copy_(views.focal_px)
        self.principal_point_px.copy_(views.principal_point_px)
        self.turns_degrees.copy_(turn_seen(theta, views.world_to_camera, avatar.layout))
        self.size_px.copy_(torch.tensor([views.width, views.height]))
        self._forget()

    def see(
        self, avatar: Avatar, theta: Float[Tensor, "B H"], cameras: PinholeCameras
    ) -> Float[Tensor, "B 3"]:
        """Take into account how far these frames of the film go.

        Returns, in the head's axes, the way back along each camera's axis.
        """
        turns = turn_seen(theta, cameras.world_to_camera, avatar.layout).to(self.turns_degrees)
        torch.minimum(self.filmed_low_degrees, turns.amin(0), out=self.filmed_low_degrees)
        torch.maximum(self.filmed_high_degrees, turns.amax(0), out=self.filmed_high_degrees)
        self._beyond = None
        return _looked_from(turns[:, :2])

    def seen_from(self) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
        """Where the film has looked at the head from, in the head's axes, and how far from there
        alone: 1 where the head never turns, 0 where it turns by `_TURNING_DEGREES` in all."""
        low, high = self.filmed_low_degrees[:2], self.filmed_high_degrees[:2]
        alone = (1 - (high - low).amax() / _TURNING_DEGREES).clamp(0, 1)
        return _looked_from(0.5 * (low + high)), alone

    def due(self, step: int, batch_size: int) -> int | None:
        """The view that takes the place of a batch's last frame at this step, if any."""
        every = max(2, round(_FRAMES_A_VIEW / batch_size))
        if step % every:
            return None
        if self._beyond is None:
            turns, clear = self.turns_degrees[:, :2], _CLEAR_DEGREES
            below = turns < self.filmed_low_degrees[:2] - clear
            above = turns > self.filmed_high_degrees[:2] + clear
            beyond = (below | above).any(1) & (self.size_px > 0).all()
            self._beyond = torch.nonzero(beyond)[:, 0].tolist()
        return self._beyond[step // every % len(self._beyond)] if self._beyond else None

    def frames(self, avatar: Avatar, views: Sequence[int]) -> ViewedFrames:
        """Some of the W views, with nothing known within the outlines yet."""
        images = torch.cat([self._mask(avatar, view).image_rgba for view in views])
        return ViewedFrames(_chosen(self.theta, list(views)), self._cameras(list(views)), images)

    def completed(
        self, avatar: Avatar, view: int, own: RenderedBatch
    ) -> UInt8[Tensor, "1 height width 4"]:
        """A view's image as the avatar is to show it: its `own` picture, closed, and smoothed but
        for the light of hair."""
        # Here, as below, so that timing steps on a bare machine needs no OpenCV.
        from rgbavatar_ns.avatar.prior.closing import closed, closed_on_device, with_light_of

        mask = self._mask(avatar, view)
        if mask.is_empty:
            return mask.image_rgba
        rows, columns = mask.box
        part = torch.cat([own.image[0, rows, columns], own.alpha[0, rows, columns]], -1)
        width = own.image.shape[2]
        if part.device.type == "cpu":
            picture = torch.from_numpy(closed(part.numpy(), width))
        else:
            picture = closed_on_device(part, width)
        stranded = (self.hair_contrast / _STRANDED).clamp(max=1)
        picture = with_light_of(part, picture, stranded * mask.hair[rows, columns])
        image = mask.image_rgba.clone()
        there = image[0, rows, columns]
        inner = mask.inner[rows, columns, None]
        there.copy_(torch.where(inner, picture.to(there), there))
        return image

    @torch.no_grad()
    def frame(self, avatar: Avatar, view: int, backend: str = "auto") -> ViewedFrames:
        """A view with its completed image."""
        known = self.frames(avatar, [view])
        here = known.cameras.to(avatar.identity)
        own = avatar.render(known.theta.to(avatar.identity), here, backend=backend)
        return replace(known, images_rgba=self.completed(avatar, view, own))

    @torch.no_grad()
    def redraw(
        self,
        avatar: Avatar,
        view: int,
        renderer: DeviceRenderer,
        image_rgba: UInt8[Tensor, "height width 4"],
    ) -> None:
        """Complete a view's image where it lies; `renderer` is the view's, by itself.

        The device is not waited for: where its picture finds no room, the image stays as it was.
        """
        own = renderer.draw_at_once(avatar.identity.new_zeros(1, 3))
        drawn = self.completed(avatar, view, own)[0]
        image_rgba.copy_(torch.where(renderer.overflowed > 0, image_rgba, drawn))

    def _mask(self, avatar: Avatar, view: int) -> "_Mask":
        if view not in self._drawn:
            self._drawn[view] = self._draw(avatar, view)
        return self._drawn[view]

    def _cameras(self, views: list[int]) -> PinholeCameras:
        if self._size is None:  # asked once, for a device would be waited for
            width, height = self.size_px.tolist()
            self._size = width, height
        return PinholeCameras(
            _chosen(self.world_to_camera, views),
            _chosen(self.focal_px, views),
            _chosen(self.principal_point_px, views),
            *self._size,
        )

    @torch.no_grad()
    def _draw(self, avatar: Avatar, view: int) -> "_Mask":
        import cv2

        from rgbavatar_ns.avatar.prior.hair_seen import haired_pixels
        from rgbavatar_ns.avatar.prior.outline import lower_rim
        from rgbavatar_ns.avatar.prior.placed_mesh import PlacedMesh, covered_pixels

        faces = avatar.head.faces.cpu().long()
        vertices = avatar.carrier_vertices(self.theta[[view]].to(avatar.identity)).cpu()
        cameras = self._cameras([view]).to("cpu")
        seen = PlacedMesh.of(vertices, vertex_normals(vertices, faces), cameras, 0)
        px, size = seen.moved(self.surface_m.cpu()), (cameras.width, cameras.height)
        there = ~(self.empty.cpu() > 0.5)[faces].any(1)
        body, rest = (covered_pixels(px, faces[k].numpy(), *size) > 0 for k in (there, ~there))
        below, under = (body_vertices(avatar.head.arrays, height_m) for height_m in _COLLAR_M)
        collar = covered_pixels(px, faces[(under & ~below)[faces].all(1)].numpy(), *size)
        away_px = cv2.distanceTransform(1 - collar, cv2.DIST_L2, cv2.DIST_MASK_3)
        unknown = body | rest | (away_px < _AROUND_COLLAR_M * seen.px_of_metre)
        rim = np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)
        inner = cv2.erode(body.astype(np.uint8), rim, borderValue=(1,)) > 0
        # What the mesh ends in goes on below it: a neck, shoulders.
        if self.goes_on_below:
            lowest = max(0, int(px[lower_rim(avatar), 1].min()))
            unknown[lowest:], inner[lowest:] = True, False
        image = np.zeros((cameras.height, cameras.width, 4), np.uint8)
        image[unknown] = UNFILMED_RGBA
        device = self.theta.device
        rows, columns = (np.flatnonzero(inner.any(axis)) for axis in (1, 0))
        image, inner = torch.from_numpy(image)[None].to(device), torch.from_numpy(inner).to(device)
        hair = haired_pixels(avatar.head.arrays, seen, px, faces.numpy(), *size)
        soft = cv2.GaussianBlur(hair.astype(np.float32), (0, 0), _HAIRLINE * cameras.width)
        soft = torch.from_numpy(soft).to(device)
        return _Mask(image, inner, (_reach(rows), _reach(columns)), soft)


@dataclass(frozen=True)
class _Mask:
    """What is known of a view before anything is drawn."""

    image_rgba: UInt8[Tensor, "1 height width 4"]
    """Background beside the outline, unfilmed within and below it."""
    inner: Bool[Tensor, "height width"]
    """Where the person is, for certain."""
    box: tuple[slice, slice]
    """The rows and columns of that."""
    hair: Float[Tensor, "height width"]
    """1 where strands may be, which are no noise."""

    @property
    def is_empty(self) -> bool:
        """Whether nobody is there for certain."""
        return any(part.start == part.stop for part in self.box)


def _looked_from(turns_degrees: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 3"]:
    """The way to the eye, in the head's axes, of who sees it turned by so much (yaw, pitch)."""
    yaw, pitch = torch.deg2rad(turns_degrees).unbind(-1)
    return torch.stack([yaw.sin() * pitch.cos(), -pitch.sin(), yaw.cos() * pitch.cos()], -1)


def _chosen(values: Float[Tensor, "W ..."], rows: list[int]) -> Tensor:
    """Some rows; one without a list of numbers, which a device would be waited for to take."""
    return values[rows[0] : rows[0] + 1] if len(rows) == 1 else values[rows]


def _reach(places: Int[np.ndarray, "P"]) -> slice:
    """From the first of sorted places to the last."""
    return slice(int(places[0]), int(places[-1]) + 1) if len(places) else slice(0, 0)
