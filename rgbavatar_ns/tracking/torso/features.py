"""Points of the clothes, followed from picture to picture: what a body does shows in them alone."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

_Gray = UInt8[np.ndarray, "H W"]
_Points = Float[np.ndarray, "P 2"]

_LEAST_QUALITY, _APART_SHARE = 0.01, 1 / 60
_WINDOW_PX, _LEVELS = 21, 3
_LEAST_POINTS = 8
_PLAIN_SHARE = 0.1
# A point that does not come back to where it started was lost on the way.
_BACK_PX = 0.7
# Points at the outline follow the background; so far within the region they are chosen, as a share
# of the picture's longer side.
_INSIDE_SHARE = 1 / 60
_GRID_SHARE = 1 / 36


def corners_within(gray: _Gray, region: Bool[np.ndarray, "H W"], most: int) -> _Points:
    """At most so many places that can be followed, well within a region; none where it is plain."""
    inside = _well_within(region)
    if not inside.any():
        return np.zeros((0, 2))
    apart = max(3.0, max(gray.shape) * _APART_SHARE)
    found = cv2.goodFeaturesToTrack(gray, most, _LEAST_QUALITY, apart, mask=inside)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


def grid_within(region: Bool[np.ndarray, "H W"]) -> _Points:
    """Places evenly over a region, well within it, whatever they show."""
    apart = max(1, round(max(region.shape) * _GRID_SHARE))
    row, column = np.nonzero(_well_within(region)[::apart, ::apart])
    return apart * np.stack([column, row], axis=1).astype(np.float64)


def _well_within(region: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """1 inside a region, without a rim; the picture's edge is one too."""
    reach = 2 * round(max(region.shape) * _INSIDE_SHARE) + 1
    return cv2.erode(region.astype(np.uint8), np.ones((reach, reach), np.uint8), borderValue=(0,))


@dataclass(frozen=True)
class FollowedPoints:
    """Points of a key picture, and how to find them again in later ones: no drift adds up.

    `certainty` says how much each point's place is known along x and y: on a stripe, only across.
    """

    key: _Gray
    points_px: _Points
    certainty: Float[np.ndarray, "P 2 2"]

    @classmethod
    def chosen(cls, gray: _Gray, region: Bool[np.ndarray, "H W"], most: int) -> "FollowedPoints":
        """The best corners within a region."""
        points = corners_within(gray, region, most)
        return cls(gray, points, _certainty(gray, points))

    def select(self, rows: Bool[np.ndarray, "P"]) -> "FollowedPoints":
        """Some of the points."""
        return FollowedPoints(self.key, self.points_px[rows], self.certainty[rows])

    def found_in(self, gray: _Gray, expected_px: _Points) -> tuple[_Points, Bool[np.ndarray, "P"]]:
        """Where each point is in another picture, looked for near `expected_px`, and which were
        found.

        Pyramidal Lucas and Kanade (Bouguet 2001), there and back, once the picture is turned as
        the points say: patches that turned would be found a little beside. Pixel centres lie at
        whole numbers, as OpenCV has it.
        """
        if len(self.points_px) < _LEAST_POINTS:
            return expected_px, np.zeros(len(self.points_px), bool)
        onward = _affine(self.points_px, expected_px)
        height, width = gray.shape
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        turned = cv2.warpAffine(gray, onward, (width, height), flags=flags,
                                borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
        start = self.points_px.astype(np.float32)[:, None]
        guess = (expected_px - onward[:, 2]) @ np.linalg.inv(onward[:, :2]).T
        there, seen = _flow(
            self.key, turned, start, guess.astype(np.float32).reshape(-1, 1, 2).copy()
        )
        back, again = _flow(turned, self.key, there, start.copy())
        missed = np.linalg.norm((back - start)[:, 0], axis=1)
        found_px = there[:, 0].astype(np.float64) @ onward[:, :2].T + onward[:, 2]
        x, y = found_px.T
        inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
        return found_px, seen & again & (missed < _BACK_PX) & inside


def _affine(from_px: _Points, to_px: _Points) -> Float[np.ndarray, "2 3"]:
    """The affine map nearest to carrying points to others, least squares.

    Where points lie in a line it leaves what is across as it is.
    """
    ones = np.concatenate([from_px, np.ones((len(from_px), 1))], axis=1)
    return np.eye(2, 3) + np.linalg.lstsq(ones, to_px - from_px, rcond=None)[0].T


def _certainty(gray: _Gray, points_px: _Points) -> Float[np.ndarray, "P 2 2"]:
    """1 along directions in which a point's surroundings are patterned, towards 0 along stripes.

    From the structure tensor S: S (S + s)^-1, where s is a tenth of the median point's largest
    eigenvalue.
    """
    if not len(points_px):
        return np.zeros((0, 2, 2))
    image = cv2.GaussianBlur(gray, (0, 0), 1.0).astype(np.float32)
    x, y = cv2.Scharr(image, cv2.CV_32F, 1, 0), cv2.Scharr(image, cv2.CV_32F, 0, 1)
    box = (_WINDOW_PX, _WINDOW_PX)
    sums = np.dstack([cv2.blur(part, box) for part in (x * x, x * y, y * y)])
    column, row = np.round(points_px).astype(int).T
    xx, xy, yy = sums[row, column].T.astype(np.float64)
    tensor = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -1)
    usual = _PLAIN_SHARE * np.median(np.linalg.eigvalsh(tensor)[:, 1])
    return tensor @ np.linalg.inv(tensor + usual * np.eye(2))


def _flow(
    first: _Gray, second: _Gray, start: np.ndarray, guess: np.ndarray
) -> tuple[np.ndarray, Bool[np.ndarray, "P"]]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        start,
        guess,
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return found, status[:, 0] > 0
