"""One picture of the room, found again in others of a camera that moves.

A camera in a hand mostly turns, and a wall is a plane: what it shows of the room in one picture and
in another are a homography apart. Of a little that stands nearer than the rest it is told that it
is elsewhere; where that is much, nothing is told.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.tracking.image.mixture import OF_SIDE_PX

_Image = UInt8[np.ndarray, "S S 3"]
_Gray = UInt8[np.ndarray, "S S"]
_Mask = Bool[np.ndarray, "S S"]
_Points = Float[np.ndarray, "P 2"]
Homography = Float[np.ndarray, "3 3"]

# Lengths are pixels of an image of `OF_SIDE_PX`, and grow with it. Features that are compared, how
# many have to agree on a homography, and by how many pixels they may be off it: at first, and when
# points are followed to fractions of one.
_FEATURES, _FEWEST, _OFF_PX, _FINELY_OFF_PX = 600, 12, 3.0, 1.0
# What a feature is told by: a patch so wide, and by how many levels a corner differs.
_PATCH_PX, _LEAST_PATCH_PX, _FAST = 31, 15, 7
# Points that are followed lie so far apart; they are followed within a window of so many pixels.
_POINTS, _QUALITY, _APART_PX, _WINDOW_PX, _LEVELS = 300, 0.01, 8.0, 15, 1
# Such a share of them has to agree: .8 to .97 do before a shelf, .3 to .6 where cupboards stand
# before it. Where most within so many pixels do not, the picture shows something else.
_AGREE_SHARE, _AROUND_PX = 0.75, 20.0
# What they enclose is such a share of the picture: a poster does not tell of the other side.
_LEAST_HULL = 0.1
# A hand does not move a picture's corner farther than such a share of its side.
_FARTHEST_SHARE = 0.5


@dataclass(frozen=True)
class Sight:
    """How a picture shows what a view of the room does."""

    homography: Homography
    """From the view's pixels to the picture's."""
    elsewhere: _Mask
    """What of the view the picture shows elsewhere, since it stands nearer or moves."""


@dataclass(frozen=True)
class RoomView:
    """What one picture shows of the room, as other pictures are compared with it."""

    gray: _Gray
    points_px: _Points
    features_px: Float[np.ndarray, "F 2"]
    descriptors: UInt8[np.ndarray, "F 32"]

    @classmethod
    def of(cls, image_rgb: _Image, room: _Mask) -> "RoomView | None":
        """`room`: where the picture shows the room; None where it is too plain to be told apart."""
        gray = _gray(image_rgb)
        features_px, descriptors = _features(gray, room)
        apart = _APART_PX * len(gray) / OF_SIDE_PX
        shown = room.astype(np.uint8)
        points = cv2.goodFeaturesToTrack(gray, _POINTS, _QUALITY, apart, mask=shown)
        if points is None or min(len(points), len(features_px)) < _FEWEST:
            return None
        return cls(gray, points.reshape(-1, 2), features_px, descriptors)

    def found_in(self, image_rgb: _Image, room: _Mask) -> Sight | None:
        """This view in a picture that shows the room where `room` says; None where it is not found.

        Ours: matched features (ORB, Rublee 2011) tell the homography roughly, and corners followed
        from there (Lucas and Kanade 1981) to fractions of a pixel.
        """
        gray, size = _gray(image_rgb), len(self.gray)
        features_px, descriptors = _features(gray, room)
        if len(features_px) < _FEWEST:
            return None
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(
            self.descriptors, descriptors
        )
        here = self.features_px[[pair.queryIdx for pair in pairs]]
        there = features_px[[pair.trainIdx for pair in pairs]]
        roughly, _ = _agreed(here, there, _OFF_PX * size / OF_SIDE_PX, 0.0)
        if roughly is None or not _of_a_hand(roughly, size):
            return None
        # Laid on this view, the picture shows each point next to where it is.
        laid = laid_on(gray, roughly, cv2.INTER_LINEAR)
        shows = laid_on(room.astype(np.uint8), roughly, cv2.INTER_NEAREST) > 0
        column, row = self.points_px.astype(int).T
        points = self.points_px[shows[row, column]]
        if len(points) < _FEWEST:
            return None
        window = (max(5, round(_WINDOW_PX * size / OF_SIDE_PX)),) * 2
        followed, seen, _ = cv2.calcOpticalFlowPyrLK(
            self.gray, laid, points, points.copy(), winSize=window, maxLevel=_LEVELS
        )
        points, followed = points[seen[:, 0] > 0], followed[seen[:, 0] > 0]
        finely, agrees = _agreed(points, followed, _FINELY_OFF_PX * size / OF_SIDE_PX, _AGREE_SHARE)
        if finely is None or not _of_a_hand(roughly @ finely, size):
            return None
        if cv2.contourArea(cv2.convexHull(points[agrees])) < _LEAST_HULL * size**2:
            return None
        return Sight(roughly @ finely, _more_around(points, ~agrees, size))


def laid_on(
    picture: np.ndarray,
    homography: Homography,
    interpolation: int,
    border: int = cv2.BORDER_CONSTANT,
) -> np.ndarray:
    """A picture as the view sees it that a homography leads from; 0, or `border`, beyond it."""
    flags, size = interpolation | cv2.WARP_INVERSE_MAP, picture.shape[1::-1]
    return cv2.warpPerspective(picture, homography, size, flags=flags, borderMode=border)


def _gray(image_rgb: _Image) -> _Gray:
    return np.asarray(cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _features(gray: _Gray, room: _Mask) -> tuple[_Points, np.ndarray]:
    """Places of features, and what each looks like."""
    # Less than 255 would leave the pyramid's smaller pictures without any.
    shown = np.where(room, np.uint8(255), np.uint8(0))
    patch = int(np.clip(round(_PATCH_PX * len(gray) / OF_SIDE_PX), _LEAST_PATCH_PX, _PATCH_PX))
    orb = cv2.ORB.create(_FEATURES, edgeThreshold=patch // 2, patchSize=patch, fastThreshold=_FAST)
    found, descriptors = orb.detectAndCompute(gray, shown)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
    return np.array([one.pt for one in found], np.float32), descriptors


def _agreed(
    here: _Points, there: _Points, off_px: float, share: float
) -> tuple[Homography | None, Bool[np.ndarray, "P"]]:
    """The homography that enough pairs of points, and such a share of them, agree on; and which."""
    none = np.zeros(len(here), bool)
    if len(here) < _FEWEST:
        return None, none
    found, agrees = cv2.findHomography(here, there, cv2.RANSAC, off_px)
    if found is None or agrees.sum() < max(_FEWEST, share * len(here)):
        return None, none
    return found, agrees[:, 0] > 0


def _more_around(points_px: _Points, these: Bool[np.ndarray, "P"], size: int) -> _Mask:
    """Where more of `these` points than of the others lie around."""
    votes = np.zeros((size, size), np.float32)
    column, row = points_px.astype(int).T
    np.add.at(votes, (row, column), np.where(these, np.float32(1), np.float32(-1)))
    around = (2 * round(_AROUND_PX * size / OF_SIDE_PX) + 1,) * 2
    return cv2.blur(votes, around, borderType=cv2.BORDER_CONSTANT) > 1e-6


def _of_a_hand(homography: Homography, size: int) -> bool:
    """Whether a camera in a hand may have moved so between two pictures."""
    corners = np.array([[0.0, 0], [size, 0], [size, size], [0, size]])
    homogeneous = np.c_[corners, np.ones(4)] @ homography.T
    if (homogeneous[:, 2] <= 0.1).any():
        return False
    moved = homogeneous[:, :2] / homogeneous[:, 2:]
    return bool(np.hypot(*(moved - corners).T).max() < _FARTHEST_SHARE * size)
