"""Which of the faces in a frame is the one that is followed."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

# Distances are in heights of the face. A face is the same one when its place and size differ by
# less than `_REACH` from what is expected; each frame in which it is not seen widens that.
_REACH, _REACH_PER_FRAME, _REACH_MOST = 0.6, 0.05, 1.2
# Two sets of landmarks this close together lie on one face.
_SAME_FACE = 0.4
# A face elsewhere is taken for the followed one after so many frames without it (a cut, a jump),
# unless it was seen beside it.
_PATIENCE = 5
# The first choice holds once it was seen so often; before, it may have been a mistake.
_ESTABLISHED = 10
_FORGET_AFTER = 50
_MOMENTUM = 0.5


@dataclass(frozen=True)
class Sighting:
    """Which face of the frame is followed (None: it is not seen), and how many others there are.

    `jumped` tells that it was found again in another place, `before` which face of earlier frames,
    counted from the first one as 0, it was there while that was not known yet.
    """

    position: int | None
    others: int
    jumped: bool = False
    before: tuple[tuple[int, int], ...] = ()


@dataclass
class _Face:
    """Where a face was last seen, how it moves a frame, since when and how often it was seen."""

    center: Float[np.ndarray, "2"]
    height: float
    frame: int
    since: int
    velocity: Float[np.ndarray, "2"] = field(default_factory=lambda: np.zeros(2))
    seen: int = 1
    last_at: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_PATIENCE))
    """The last frames in which it was seen, and its position there."""

    def misfit(self, center: Float[np.ndarray, "2"], height: float, frame: int) -> float:
        """How far a sighting is from what is expected; inf where it is out of reach."""
        missed = frame - self.frame
        expected = self.center + self.velocity * min(missed, _PATIENCE)
        away = float(np.linalg.norm(center - expected)) / max(height, self.height)
        away += abs(float(np.log(height / self.height)))
        reach = min(_REACH + _REACH_PER_FRAME * (missed - 1), _REACH_MOST)
        return away - reach if away < reach else np.inf

    def move(self, center: Float[np.ndarray, "2"], height: float, frame: int) -> None:
        """Seen again."""
        speed = (center - self.center) / (frame - self.frame)
        if frame - self.frame > 1:
            speed = np.zeros(2)
        self.velocity = _MOMENTUM * self.velocity + (1 - _MOMENTUM) * speed
        self.center, self.height, self.frame = center, height, frame
        self.seen += 1


class FaceFollower:
    """Keeps to one face over the frames of a video, in order.

    It begins with the largest and most central face; then every face goes to the nearest known one
    by expected place and size, all faces of a frame together, so that another face that enters or
    crosses is not taken for the followed one. A face that was seen beside the followed one never
    replaces it. Depends on the sightings alone.
    """

    def __init__(self) -> None:
        self._frame = 0
        self._followed: _Face | None = None
        self._others: list[_Face] = []

    def __call__(self, faces_px: Float[np.ndarray, "N 478 2"], width: int, height: int) -> Sighting:
        """Judge the next frame, of `width` x `height` pixels, by the landmarks of its faces."""
        self._frame += 1
        centers, heights = faces_px.mean(1), np.ptp(faces_px[..., 1], axis=1) + 1e-6
        distinct = _distinct(centers, heights)
        self._others = [face for face in self._others if self._frame - face.frame <= _FORGET_AFTER]
        if self._followed is None and distinct:
            middle = np.array([width, height]) / 2
            off = np.linalg.norm((centers - middle) / (width, height), axis=1)
            first = max(distinct, key=lambda k: heights[k] * (1 - min(float(off[k]), 1.0)))
            self._followed = self._new(centers[first], heights[first], self._frame - 1)
        owners = self._assign(distinct, centers, heights)
        position = next((k for k, owner in owners.items() if owner is self._followed), None)
        jumped, before = False, ()
        if position is None:
            position = self._elsewhere(owners, heights)
            jumped = position is not None
        for k in distinct:
            owner = owners.get(k)
            if k == position and jumped:
                if owner is not None and self._followed is not None:
                    lost = self._followed.frame
                    before = tuple((at - 1, place) for at, place in owner.last_at if at > lost)
                self._followed = self._new(centers[k], heights[k], self._frame)
                self._others = [face for face in self._others if face is not owner]
            elif owner is None:
                entered = self._new(centers[k], heights[k], self._frame)
                entered.last_at.append((self._frame, k))
                self._others.append(entered)
            else:
                owner.move(centers[k], float(heights[k]), self._frame)
                owner.last_at.append((self._frame, k))
        return Sighting(position, len(distinct) - (position is not None), jumped, before)

    def _new(self, center: Float[np.ndarray, "2"], height: float, frame: int) -> _Face:
        return _Face(center, float(height), frame, self._frame)

    def _assign(
        self,
        distinct: list[int],
        centers: Float[np.ndarray, "N 2"],
        heights: Float[np.ndarray, "N"],
    ) -> "dict[int, _Face | None]":
        """Known face of each sighting, so that all misfits together are smallest."""
        known = ([] if self._followed is None else [self._followed]) + self._others
        owners: dict[int, _Face | None] = dict.fromkeys(distinct)
        if not known or not distinct:
            return owners
        misfits = np.array(
            [
                [face.misfit(centers[k], float(heights[k]), self._frame) for face in known]
                for k in distinct
            ]
        )
        rows, columns = linear_sum_assignment(np.minimum(misfits, 0))
        for row, column in zip(rows, columns):
            if misfits[row, column] < 0:
                owners[distinct[row]] = known[column]
        return owners

    def _elsewhere(
        self, owners: "dict[int, _Face | None]", heights: Float[np.ndarray, "N"]
    ) -> int | None:
        """Another place in which the followed face may have turned up, once it is long gone."""
        lost = self._followed
        if lost is None or self._frame - lost.frame <= _PATIENCE:
            return None
        candidates = [
            k
            for k, owner in owners.items()
            if owner is None
            or owner.since > lost.frame
            or lost.seen < min(_ESTABLISHED, owner.seen)
        ]
        return max(candidates, key=lambda k: heights[k], default=None)


def _distinct(centers: Float[np.ndarray, "N 2"], heights: Float[np.ndarray, "N"]) -> list[int]:
    """Positions of the sightings without those that lie on the face of an earlier one."""
    kept: list[int] = []
    for k in range(len(centers)):
        apart = np.linalg.norm(centers[kept] - centers[k], axis=1)
        if not (apart < _SAME_FACE * np.maximum(heights[kept], heights[k])).any():
            kept.append(k)
    return kept
