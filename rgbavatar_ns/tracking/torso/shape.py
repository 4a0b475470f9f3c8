"""How high a person's shoulders are, as the outline shows them."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion

_PERSON = 0.5
# Beside the neck's joint, along the body's own x: between them hair seldom hangs down and arms
# seldom begin.
_BESIDE_M = np.linspace(0.08, 0.18, 11)
# Cloth lies so far off the skin, and less than so much is the outline's own error.
_CLOTH_CM, _DOUBT_CM = 0.5, 0.7
_LOWEST_CM, _HIGHEST_CM = -3.0, 7.0
# What ends so far above the mesh's shoulder is a chair's back, a head or a raised arm.
_NO_SHOULDER_CM = 10.0
# Hair and collars only raise an outline: the lower of both sides' and most frames' heights counts.
_PERCENTILE = 40
_LEAST = 12


@dataclass(frozen=True)
class ShoulderLine:
    """In one frame, how far above the neck's joint the person ends, beside it: centimetres.

    `above_cm` has the left side's places, then the right side's; NaN where the picture shows none.
    """

    position: int
    above_cm: Float[np.ndarray, "_"]


def shoulder_line(
    position: int,
    matte: Float[np.ndarray, "h w"],
    neck_m: Float[np.ndarray, "3"],
    camera: StillCamera,
) -> ShoulderLine:
    """The matte's upper end beside the neck's joint; the camera is the matte's."""
    depth = camera.distance_m - neck_m[2]
    px_per_m = camera.focal_px / depth
    x, y = camera.project(neck_m)
    height, width = matte.shape
    found = []
    for offset in (*_BESIDE_M, *-_BESIDE_M):
        column = round(x + offset * px_per_m)
        rows = np.flatnonzero(matte[:, column] > _PERSON) if 0 <= column < width else []
        # A person who begins at the picture's own end is not seen to end there.
        seen = len(rows) > 0 and 0 < rows[0] < height - 2
        found.append(100 * (y - rows[0]) / px_per_m if seen else np.nan)
    return ShoulderLine(position, np.array(found))


def shoulders_up_cm(
    body: BodyMesh,
    camera: StillCamera,
    lines: Sequence[ShoulderLine],
    rotation: Float[np.ndarray, "F 3 3"],
) -> float:
    """How much higher the person's shoulders are than the mesh's; 0 where that is not plain."""
    apart = []
    for line in lines:
        own = _mesh_line_cm(body, camera, rotation[line.position])
        both = line.above_cm - own
        both[both > _NO_SHOULDER_CM] = np.nan
        sides = [part[np.isfinite(part)] for part in np.split(both, 2)]
        apart += [np.median(side) for side in sides if len(side) >= 3]
    if len(apart) < min(_LEAST, len(lines)) or not apart:
        return 0.0
    up = float(np.percentile(apart, _PERCENTILE)) - _CLOTH_CM
    plain = np.sign(up) * max(0.0, abs(up) - _DOUBT_CM)
    return float(np.clip(plain, _LOWEST_CM, _HIGHEST_CM))


def _mesh_line_cm(
    body: BodyMesh, camera: StillCamera, rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "_"]:
    """The same line of the mesh, drawn to a picture of its own."""
    # Two millimetres a pixel, the neck's joint in its middle.
    size, middle = 300, 150
    px_per_m = 500.0
    placed = RigidMotion(rotation, -rotation @ body.neck_m)
    points = placed(body.vertices_m)
    near = camera.distance_m / (camera.distance_m - points[:, 2:])
    px = points[:, :2] * near * px_per_m * [1, -1] + middle
    drawn = np.zeros((size, size), np.uint8)
    for triangle in np.round(px[body.faces] * 8).astype(np.int32):
        cv2.fillConvexPoly(drawn, triangle, (1,), shift=3)
    found = []
    for offset in (*_BESIDE_M, *-_BESIDE_M):
        rows = np.flatnonzero(drawn[:, round(middle + offset * px_per_m)])
        found.append(100 * (middle - rows[0]) / px_per_m if len(rows) else np.nan)
    return np.array(found)
