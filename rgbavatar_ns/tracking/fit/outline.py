"""The person's outline in a matte as evidence: the head must lie within it, under some hair.

Ours, because landmarks of the face know neither the height of a skull nor where the ears are.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead, Unknowns
from rgbavatar_ns.tracking.fit.levenberg_marquardt import QuadraticModel
from rgbavatar_ns.tracking.fit.pose_chain import SKULL

_Theta = Float[np.ndarray, "H"]
_Identity = Float[np.ndarray, "I"]

SIGMA_M = 0.003
FAR_M = 0.02
POINTS = 240


@dataclass(frozen=True)
class PersonOutline:
    """How far each place of a frame lies outside of the person, in pixels of the frame.

    `outside_px` is negative within the person. Its first value stands at `first_px` (column, row)
    of the frame, and the next one `step_px` on; beyond its border the border goes on.
    """

    outside_px: Float[np.ndarray, "h w"]
    first_px: Float[np.ndarray, "2"]
    step_px: float

    def at(
        self, points_px: Float[np.ndarray, "N 2"]
    ) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N 2"]]:
        """Distances of points, and how they change with column and row."""
        place = (points_px - self.first_px) / self.step_px
        most = np.array(self.outside_px.shape[::-1]) - 1.0
        place = np.clip(place, 0, most)
        corner = np.minimum(np.floor(place), most - 1).astype(np.int64)
        (x, y), (column, row) = (place - corner).T, corner.T
        field = self.outside_px
        a, b = field[row, column], field[row, column + 1]
        c, d = field[row + 1, column], field[row + 1, column + 1]
        upper, lower = a + x * (b - a), c + x * (d - c)
        slope = np.stack([(1 - y) * (b - a) + y * (d - c), lower - upper], axis=1)
        return upper + y * (lower - upper), slope / self.step_px


class OutlineCost:
    """What it costs that the head stands out of the outline."""

    def __init__(self, head: HeadModel, columns: Int[np.ndarray, "P"], identity_columns: int) -> None:
        ids = _spread_vertices(head)
        corners = np.repeat(ids[:, None], 3, axis=1)
        self.head = LandmarkHead(head, corners, np.tile([1.0, 0.0, 0.0], (len(ids), 1)))
        self._unknowns = self.head.unknowns(columns, identity_columns)

    def value(self, theta, identity, outline, camera) -> float:
        points = self.head.points(theta, identity)
        return self._cost(points, outline, camera)[0]

    def model(self, theta, identity, outline, camera) -> QuadraticModel:
        points, derivative = self.head.jacobian(theta, identity, self._unknowns)
        cost, pull, weight, slope = self._cost(points, outline, camera)
        asked = np.flatnonzero(weight)
        jac = camera.image_derivative(points[asked], derivative[:, asked])
        rows = np.einsum("ni,niq->nq", slope[asked], jac)
        return QuadraticModel(cost, rows.T @ pull[asked], rows.T @ (rows * weight[asked, None]))

    def _cost(self, points, outline, camera):
        """cost, its derivative by distance px, curvature, slope"""
        distance_px, slope = outline.at(camera.project(points))
        metre = (camera.distance_m - points[:, 2]) / camera.focal_px
        d = np.maximum(distance_px * metre, 0)
        share = 1 / (1 + (d / FAR_M) ** 2)
        cost = 0.5 * float(((d / SIGMA_M) ** 2 * share).sum())
        weight = share**2 / SIGMA_M**2 * (d > 0)
        return cost, weight * d * metre, weight * metre**2, slope


def _spread_vertices(head: HeadModel) -> np.ndarray:
    arrays = head.arrays
    template, weights = arrays.v_template, arrays.skinning_weights
    skin = np.zeros(len(template), bool)
    skin[arrays.vertex_groups["skin"]] = True
    may = np.flatnonzero((weights[:, SKULL] > 0.95) & skin & (template[:, 1] > -0.03))
    chosen = [int(may[np.argmax(template[may, 1])])]
    nearest = np.linalg.norm(template[may] - template[chosen[0]], axis=1)
    while len(chosen) < POINTS:
        chosen.append(int(may[np.argmax(nearest)]))
        nearest = np.minimum(nearest, np.linalg.norm(template[may] - template[chosen[-1]], axis=1))
    return np.array(chosen)


def person_outline(alpha, face_px, first_px, step_px) -> PersonOutline | None:
    """alpha [h,w] float, face landmarks in alpha pixel coords (center .5)."""
    solid = (alpha > 0.5).astype(np.uint8)
    hull = cv2.convexHull(face_px.astype(np.float32))
    face = cv2.fillConvexPoly(np.zeros_like(solid), np.round(hull).astype(np.int32), 1)
    contours, _ = cv2.findContours(solid, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    best, most = None, 0
    for contour in contours:
        filled = cv2.drawContours(np.zeros_like(solid), [contour], 0, 1, cv2.FILLED)
        both = int((filled & face).sum())
        if both > most:
            best, most = filled, both
    if best is None or most < 0.8 * face.sum():
        return None
    # the border goes on
    pad = 2
    out = cv2.distanceTransform(1 - best, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inn = cv2.distanceTransform(best, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    signed = np.where(best > 0, 0.5 - inn, out - 0.5)
    return PersonOutline(signed * step_px, np.asarray(first_px), step_px)
