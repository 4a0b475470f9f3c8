"""How far a person stands off the head's mesh, as the outlines of mattes show it.

Where a mesh turns away from the camera, the matte's border beside it is where the person ends: hair
has volume there, and a chin may lie deeper. Closed form, a second for ten frames; nothing learns.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.prior.hair_seen import hair_contrast
from rgbavatar_ns.avatar.prior.mesh_field import MeshField, Outline
from rgbavatar_ns.avatar.prior.placed_mesh import PlacedMesh, covered_pixels
from rgbavatar_ns.drawing.compositing import unfilmed_pixels
from rgbavatar_ns.head.surface import MeshEdges, vertex_normals
from rgbavatar_ns.kernels import PinholeCameras

_GRAZING = 0.25
"""Largest cosine between a rim's normal and the view."""
_AGREES = 0.7
"""Smallest cosine between the rim's normal and the matte's in the picture."""
_REACH_M = 0.04
"""Farther borders belong to something else."""
_BESIDE_PX = 3.0
_LIFT_M, _LEAST_UPWARDS = 0.1, 0.5
"""Clothes stand farther off than hair; normals have so much of upwards where a body is lifted."""
_SPREAD, _LEAST_ALIKE = 0.12, 0.02
_REST, _SCALP_REST = 0.05, 0.0005
"""How soon the offset goes back to none away from a rim; hair goes around the head."""
_MOST_FRAMES = 4.0
"""Confidence of a vertex never exceeds that of so many frames."""
_ITERATIONS = 200
_MAP_COLUMNS = 1024
_IN_PICTURE = 0.25
"""Share of the frames that have a part of a body in the picture, below which it is left out: mattes
fade where so many show it (`tracking/image/body_end.py`)."""
_LOWEST = 0.02
"""Share of a body's front that may lie below its end: specks of a matte."""


@dataclass
class _Sums:
    """Over frames, by vertex."""

    distance_m: np.ndarray
    rims: np.ndarray
    color: np.ndarray
    facing: np.ndarray


@torch.no_grad()
def measure_outline(
    avatar: Avatar,
    field: MeshField,
    theta: Float[Tensor, "B H"],
    cameras: PinholeCameras,
    images_rgba: UInt8[Tensor, "B height width 4"],
) -> Outline:
    """Compare the mesh's rim with the mattes of frames; between rims the offset is continued.

    It spreads where the person looks alike: hair is thick, the forehead beside it is not. Ours,
    because parallax alone does not move Gaussians that can be painted over.
    """
    faces = avatar.head.faces.cpu().long()
    vertices = avatar.carrier_vertices(theta)
    normals = vertex_normals(vertices.cpu(), faces)
    images = images_rgba.cpu().numpy()
    count = vertices.shape[1]
    sums = _Sums(*(np.zeros((count, *size), np.float32) for size in ((), (), (3,), ())))
    placed = [PlacedMesh.of(vertices.cpu(), normals, cameras, k) for k in range(len(theta))]
    for image, seen in zip(images, placed):
        _add_frame(sums, image, seen, faces.numpy(), field)
    facing = torch.from_numpy(sums.facing)
    colors = torch.from_numpy(sums.color) / facing[:, None].clamp(min=1e-6)
    offset = torch.from_numpy(sums.distance_m / np.maximum(sums.rims, 1))[:, None]
    confidence = torch.from_numpy(sums.rims).clamp(max=_MOST_FRAMES)
    device = vertices.device
    alike = field.likeness(colors.to(device), (facing > 0.5).to(device), _SPREAD, _LEAST_ALIKE)
    offset, confidence = offset.to(device), confidence.to(device)
    rest = torch.where(field.scalp, _SCALP_REST, _REST).to(device)
    offset = field.continued(
        offset, confidence, offset, stiffness=alike, rest=rest, iterations=_ITERATIONS
    )[:, 0]
    moved = [seen.moved(offset.cpu()) for seen in placed]
    shares = [_on_background(image, px) for image, px in zip(images, moved)]
    empty, known = (torch.from_numpy(np.mean(part, 0)).to(device) for part in zip(*shares))
    empty = empty[:, None] / known[:, None].clamp(min=1e-6)
    # What no frame has in the picture is there or not as its surroundings are.
    empty = field.continued(
        empty, 100 * known, empty, stiffness=1.0, rest=1e-6, iterations=_ITERATIONS
    )[:, 0]
    empty_gaussians = field.at_gaussians(empty[:, None])[:, 0]
    # But a body ends where the picture does: nobody knows what is worn farther down.
    empty[field.body & (known < _IN_PICTURE)] = 1.0
    if bool(field.body.any()):
        front = field.at_gaussians((facing > 0).to(empty)[:, None])[:, 0] > 0.5
        told, end_m = _told_of_body(field, images, moved, front & field.body_gaussians)
        empty_gaussians = torch.where(field.body_gaussians, told, empty_gaussians)
        empty[field.body & (field.height_m < end_m)] = 1.0
    rim = lower_rim(avatar)
    below = [_shown_below(image, seen, rim) for image, seen in zip(images, placed)]
    return Outline(
        offset,
        empty.clamp(0, 1),
        empty_gaussians.clamp(0, 1),
        bool(np.mean(below) > 0.1),
        hair_contrast(avatar.head.arrays, images, placed, moved, faces.numpy()),
    )


def _told_of_body(
    field: MeshField,
    images: UInt8[np.ndarray, "B height width 4"],
    moved_px: list[Float[np.ndarray, "V 2"]],
    front: Bool[Tensor, "N"],
) -> tuple[Float[Tensor, "N"], Float[Tensor, ""]]:
    """Share of the frames in which each Gaussian of a body would lie on background, and the height
    at rest, in metres, at which the body ends.

    By its own place, since vertices of a body lie centimetres apart. What few frames have in the
    picture is empty, and so is the back farther down than where the front ends, which hides it.
    """
    height = field.at_gaussians(field.height_m[:, None])[:, 0]
    px = [field.at_gaussians(torch.from_numpy(each).to(height)) for each in moved_px]
    shares = [_on_background(image, at.cpu().numpy()) for image, at in zip(images, px)]
    empty, known = (torch.from_numpy(np.mean(part, 0)).to(height) for part in zip(*shares))
    empty = torch.where(known >= _IN_PICTURE, empty / known.clamp(min=1e-6), 1.0)
    shown = height[front & (empty < 0.5)]
    end_m = shown.quantile(_LOWEST) if len(shown) else height.new_tensor(-torch.inf)
    return torch.where(height < end_m, 1.0, empty), end_m


def _add_frame(
    sums: _Sums, image: np.ndarray, seen: PlacedMesh, faces: np.ndarray, field: MeshField
) -> None:
    """Rims with their distance to the matte's border, and colours of what faces the camera."""
    height, width = image.shape[:2]
    px, view = seen.moved(0.0), F.normalize(seen.places_m, dim=-1)
    along = (seen.normals * view).sum(-1).numpy()
    outwards = F.normalize(seen.normals[:, :2], dim=-1).numpy()
    mesh = covered_pixels(px, faces, width, height)
    depth = _signed_distance_px((image[..., 3] > 127) | unfilmed_pixels(image))
    rows, columns = np.gradient(depth)
    inwards = np.stack([_at(columns, px), _at(rows, px)], 1)
    beside = _at(mesh.astype(np.float32), px + _BESIDE_PX * outwards)
    filmed = _at(unfilmed_pixels(image).astype(np.float32), px) < 0.1
    # A rim's vertex may lie a little within the mesh's own outline.
    apart = _at(depth, px) - _at(_signed_distance_px(mesh > 0), px)
    metres = apart * seen.places_m[:, 2].numpy() / float(seen.focal_px[0])
    rim = (np.abs(along) < _GRAZING) & (beside >= 0) & (beside < 0.1) & filmed
    rim &= (-(inwards * outwards).sum(1) > _AGREES) & (np.abs(metres) < _REACH_M)
    upper = (field.body.cpu() & (seen.normals[:, 1] < -_LEAST_UPWARDS)).numpy()
    if seen.is_upright(field.height_m.cpu()):
        lifts_px, at_rim = _lifts_px(image, mesh, px)
        lifts_m = lifts_px * seen.places_m[:, 2].numpy() / float(seen.focal_px[1])
        lifted = at_rim & filmed & (np.abs(lifts_m) < _LIFT_M)
        metres, rim = np.where(upper, lifts_m, metres), np.where(upper, lifted, rim)
    sums.distance_m[rim] += metres[rim]
    sums.rims[rim] += 1
    covered = image[..., 3:].astype(np.float32) / 255
    soft = cv2.GaussianBlur(np.concatenate([image[..., :3] / 255 * covered, covered], 2), (0, 0), 1)
    color = _at(soft.astype(np.float32), px)
    facing = (-along - 0.2).clip(0) * (color[:, 3] > 0.95)
    sums.color += color[:, :3] * facing[:, None]
    sums.facing += facing


def _lifts_px(
    image: np.ndarray,
    mesh: UInt8[np.ndarray, "height width"],
    px: Float[np.ndarray, "V 2"],
) -> tuple[Int[np.ndarray, "V"], Bool[np.ndarray, "V"]]:
    """How far the matte ends above the mesh's upper rim, and which vertices are of that rim.

    Straight up, since shoulders hardly show where they turn away, and between neck and shoulder
    the normals of a mesh that lies lower point at the neck.
    """
    height, width = mesh.shape
    column, row = np.floor(px.clip(0, [width - 1, height - 1])).astype(int).T
    above = np.maximum(row - round(_BESIDE_PX), 0)
    rim = (mesh[row, column] > 0) & (mesh[above, column] == 0)
    unfilmed = unfilmed_pixels(image)
    matte = (image[..., 3] > 127) | unfilmed
    top, mesh_top = (_first_rows(mask)[row, column] for mask in (matte, mesh > 0))
    rim &= (top > 0) & (top < height) & ~unfilmed[top.clip(0, height - 1), column]
    return mesh_top - top, rim & (px > 0).all(1) & (px < [width, height]).all(1)


def _first_rows(mask: Bool[np.ndarray, "height width"]) -> Int[np.ndarray, "height width"]:
    """The row at which each pixel's column enters the mask that holds it, or the next one below;
    beyond the last where there is none."""
    rows = np.arange(len(mask))[:, None]
    begins = mask & ~np.pad(mask, ((1, 0), (0, 0)))[:-1]
    last = np.maximum.accumulate(np.where(begins, rows, -1), 0)
    following = np.minimum.accumulate(np.where(begins, rows, 2 * len(mask))[::-1], 0)[::-1]
    return np.where(mask, last, following)


def _signed_distance_px(
    mask: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Distance to a mask's border, positive inside; the picture's own border is none."""
    inside = mask.astype(np.uint8)
    # Where a mask has no border, OpenCV's distance is not finite.
    within, beyond = (
        cv2.distanceTransform(m, cv2.DIST_L2, 5).clip(max=sum(mask.shape))
        for m in (inside, 1 - inside)
    )
    return cv2.GaussianBlur(np.where(mask, within - 0.5, 0.5 - beyond), (0, 0), 0.7)


def lower_rim(avatar: Avatar) -> Int[np.ndarray, "R"]:
    """The vertices at the mesh's border that lie below its middle."""
    edges = MeshEdges.of(avatar.head.faces.cpu().long())
    border = torch.unique(edges.ends[edges.num_faces == 1]).numpy()
    height = np.asarray(avatar.head.arrays.v_template)[:, 1]
    return border[height[border] < (height.min() + height.max()) / 2]


def _shown_below(image: np.ndarray, seen: PlacedMesh, rim: Int[np.ndarray, "R"]) -> float:
    """Share of the matte that is there below the lowest of the rim, over what the mesh is wide."""
    height, width = image.shape[:2]
    px = seen.moved(0.0)
    if not len(rim) or not 0 <= (lowest := int(px[rim, 1].max()) + 1) < height - 1:
        return 0.0
    left, right = (
        int(end) for end in px[:, 0].clip(0, width)[[px[:, 0].argmin(), px[:, 0].argmax()]]
    )
    below = image[lowest:, left : max(right, left + 1), 3] > 127
    return float(below.mean()) if below.size else 0.0


def _on_background(
    image: np.ndarray, px: np.ndarray
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """Which places lie on background, and which of all were filmed."""
    filmed = ~unfilmed_pixels(image)
    background = (image[..., 3] < 26) & filmed
    found = _at(np.dstack([background, filmed]).astype(np.float32), px) > 0.5
    return found[:, 0].astype(np.float32), found[:, 1].astype(np.float32)


def _at(values: np.ndarray, px: Float[np.ndarray, "P 2"]) -> np.ndarray:
    """Bilinear values of an image at places; -1 beyond its border."""
    # OpenCV takes a map of 32,767 rows at most.
    wide = -(-len(px) // _MAP_COLUMNS) * _MAP_COLUMNS
    places = np.zeros((wide, 2), np.float32)
    places[: len(px)] = px - 0.5
    column, row = np.ascontiguousarray(places.T).reshape(2, -1, _MAP_COLUMNS)
    found = cv2.remap(
        values.astype(np.float32), column, row, cv2.INTER_LINEAR, borderValue=(-1, -1, -1, -1)
    )
    return found.reshape(wide, *values.shape[2:])[: len(px)]
