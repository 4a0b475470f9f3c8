"""The person's outline as evidence: the head lies within it, under hair about as thick all over.

Ours, because landmarks of a face know neither how high its skull is nor where its ears are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.hair import haired_vertices
from rgbavatar_ns.head.joints import NECK
from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead
from rgbavatar_ns.tracking.fit.levenberg_marquardt import Evaluation, QuadraticModel

_Theta = Float[np.ndarray, "H"]
_Identity = Float[np.ndarray, "I"]
_Points = Float[np.ndarray, "N 3"]
_PerPoint = Float[np.ndarray, "N"]

# A matte knows an edge to about a pixel of 256, some millimetres. What lies much farther out is no
# error of the head but of the matte: it costs a constant. Landmarks alone put skulls up to 2 cm too
# high; a matte that lacks twice as much has left out a hat, or hair, and says nothing about a head.
_OUTSIDE_M, _LOST_M, _LEFT_OUT_M = 0.002, 0.02, 0.04
# Hair is as thick all over to about this, but for a bun, a brim or what hangs down; which is one
# person's habit in all key frames alike, so that less is known than so many points would say.
_HAIR_EVEN_M, _NO_HAIR_M = 0.008, 0.012
_HAIR_WEIGHT = 2.0
_THICKEST_M = 0.06
# Directions in which the mesh's outermost point is looked for, from straight up to both sides, a
# little beyond the ears' tops; below there hang hair and neck.
_FAN_RAD, _DIRECTIONS = np.radians(120), 49
_SPREAD_POINTS = 240  # about 9 mm apart
_BELOW_EYES_M = 0.06  # the upper lip: below it the jaw moves
_RIGID = 0.95


@dataclass(frozen=True)
class PersonOutline:
    """How far each place of a frame lies outside of the person, pixels; negative within.

    The first value stands at `first_px` (column, row) of the frame and the next one `step_px`
    farther on; beyond the last one the border's values go on.
    """

    outside_px: Float[np.ndarray, "h w"]
    first_px: Float[np.ndarray, "2"]
    step_px: float

    def at(self, points_px: Float[np.ndarray, "N 2"]) -> tuple[_PerPoint, Float[np.ndarray, "N 2"]]:
        """Distances at points of the frame, and how they grow with column and row."""
        most = np.array(self.outside_px.shape[::-1], np.float64) - 1
        unbounded = (points_px - self.first_px) / self.step_px
        place = np.clip(unbounded, 0, most)
        corner = np.minimum(np.floor(place), most - 1).astype(np.int64)
        (x, y), (column, row) = (place - corner).T, corner.T
        field = self.outside_px
        left, right = field[row, column], field[row, column + 1]
        left_below, right_below = field[row + 1, column], field[row + 1, column + 1]
        here, below = left + x * (right - left), left_below + x * (right_below - left_below)
        across = (1 - y) * (right - left) + y * (right_below - left_below)
        slope = np.stack([across, below - here], 1) / self.step_px
        return here + y * (below - here), slope * (unbounded == place)


@dataclass(frozen=True)
class OutlineTerms:
    """What a frame's cost depends on beside the pose and the person.

    `to_upright` turns the image so that the forehead is straight above the chin. `hair_m` is how
    thick hair is taken to be; None only asks that the head lies within.
    """

    outline: PersonOutline
    camera: StillCamera
    to_upright: Float[np.ndarray, "2 2"]
    hair_m: float | None = None


class OutlineCost:
    """What it costs that the head stands out of the person's outline, or lies too deep in it.

    `columns` are entries of theta; derivatives to them come first, then to the first
    `identity_columns` coefficients of the identity.
    """

    def __init__(
        self, head: HeadModel, columns: Int[np.ndarray, "P"], identity_columns: int
    ) -> None:
        chosen = spread_vertices(head)
        self._haired = haired_vertices(head.arrays)[chosen]
        corners = np.repeat(chosen[:, None], 3, axis=1)
        self._head = LandmarkHead(head, corners, np.tile([1.0, 0.0, 0.0], (len(corners), 1)))
        self._unknowns = self._head.unknowns(columns, identity_columns)

    def at(self, theta: _Theta, identity: _Identity, terms: OutlineTerms) -> Evaluation:
        """The cost of a pose and a person."""
        posed, camera = self._head.posed(theta, identity), terms.camera
        cost, pull, weight = self._explained(posed.points_m, terms)

        def model() -> QuadraticModel:
            asked = np.flatnonzero(weight)
            points = posed.points_m[asked]
            derivative = self._head.derivative(posed, self._unknowns)[asked]
            away_px, slope = terms.outline.at(camera.project(points))
            moved = np.einsum("ni,niq->nq", slope, camera.image_slope(points) @ derivative)
            # A distance in metres is one in pixels times the depth.
            rows = moved * _metres_a_pixel(points, camera)[:, None]
            rows -= (away_px / camera.focal_px)[:, None] * derivative[:, 2]
            hessian = rows.T @ (rows * weight[asked, None])
            return QuadraticModel(cost, rows.T @ pull[asked], hessian)

        return Evaluation(cost, model)

    def tells(self, theta: _Theta, identity: _Identity, terms: OutlineTerms) -> bool:
        """Whether the outline may be believed where landmarks alone put the head."""
        points = self._head.points(theta, identity)
        return bool(self._rim_m(points, terms)[1].max() < _LEFT_OUT_M)

    def hair_m(
        self,
        thetas: Sequence[_Theta],
        identity: _Identity,
        terms: Sequence[OutlineTerms],
    ) -> float:
        """How thick hair is: the median over the rims of all frames, metres."""
        found = []
        for theta, frame in zip(thetas, terms):
            rim, away_m = self._rim_m(self._head.points(theta, identity), frame)
            found.append(-away_m[self._haired[rim]])
        return float(np.clip(np.median(np.concatenate(found)), 0, _THICKEST_M))

    def _explained(
        self, points: _Points, terms: OutlineTerms
    ) -> tuple[float, _PerPoint, _PerPoint]:
        """Cost, its gradient to each point's distance in metres, and its curvature.

        Geman and McClure's loss, so that what is far off counts ever less.
        """
        rim, away_m = self._rim_m(points, terms)
        out_m = np.maximum(away_m, 0)
        loss, even = _geman_mcclure(out_m, _OUTSIDE_M, _LOST_M)
        pull, weight = np.zeros(len(points)), np.zeros(len(points))
        cost, pull[rim], weight[rim] = float(loss.sum()), even * out_m, even * (out_m > 0)
        if terms.hair_m is not None:
            under_hair = self._haired[rim]
            haired, apart_m = rim[under_hair], away_m[under_hair] + terms.hair_m
            loss, even = _geman_mcclure(apart_m, _HAIR_EVEN_M, _NO_HAIR_M)
            cost += _HAIR_WEIGHT * float(loss.sum())
            pull[haired] += _HAIR_WEIGHT * even * apart_m
            weight[haired] += _HAIR_WEIGHT * even
        return cost, pull, weight

    def _rim_m(
        self, points: _Points, terms: OutlineTerms
    ) -> tuple[Int[np.ndarray, "K"], Float[np.ndarray, "K"]]:
        """The mesh's rim, and how far out of the person it lies, metres.

        The farthest points in directions around the top of the head. What lies deeper within the
        mesh has no say: where the matte lacks that, the matte is wrong.
        """
        points_px = terms.camera.project(points)
        angle = np.linspace(-_FAN_RAD, _FAN_RAD, _DIRECTIONS)
        outwards = np.stack([np.sin(angle), -np.cos(angle)], axis=1) @ terms.to_upright
        rim = np.unique((points_px @ outwards.T).argmax(0))
        away_px, _ = terms.outline.at(points_px[rim])
        return rim, away_px * _metres_a_pixel(points[rim], terms.camera)


def spread_vertices(head: HeadModel) -> Int[np.ndarray, "N"]:
    """Vertices all over the rigid part of the head, ears included, about evenly far apart.

    Each next one is the farthest from those before it.
    """
    arrays = head.arrays
    template = arrays.v_template.astype(np.float64)
    eyes_m = (arrays.joint_regressor.astype(np.float64) @ template)[-2:, 1].mean()
    rigid = arrays.skinning_weights[:, NECK] > _RIGID
    may = np.flatnonzero(rigid & (template[:, 1] > eyes_m - _BELOW_EYES_M))
    places = template[may]
    chosen = [int(np.argmax(places[:, 1]))]
    nearest = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(_SPREAD_POINTS, len(may)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return may[chosen]


def _metres_a_pixel(points: _Points, camera: StillCamera) -> _PerPoint:
    """How long a pixel is at each point, across the line of sight."""
    return (camera.distance_m - points[:, 2]) / camera.focal_px


def _geman_mcclure(
    distance_m: _PerPoint, width_m: float, far_m: float
) -> tuple[_PerPoint, _PerPoint]:
    """Loss of standard deviation `width_m`, and its weight (derivative by distance^2 / 2)."""
    share = 1 / (1 + (distance_m / far_m) ** 2)
    return 0.5 * (distance_m / width_m) ** 2 * share, share**2 / width_m**2
