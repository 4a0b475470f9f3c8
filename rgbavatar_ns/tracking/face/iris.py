"""Irises found in the picture itself: a drawn eye laid over the small patch that shows one."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.tracking.face.detector import (
    EYE_CORNERS,
    IRIS_CENTERS,
    IRIS_RIMS,
    LID_PAIRS,
    irises_seen,
)
from rgbavatar_ns.tracking.face.drawn_eye import (
    ACROSS,
    CENTER,
    DOWN,
    IRIS,
    LASHES,
    LOG_RADIUS,
    LOWER_LID,
    OBLIQUE,
    PARAMETERS,
    PUPIL,
    SCLERA,
    SHAPE,
    SKIN,
    STEP,
    UPPER_LID,
    drawn_eye,
)

# What is known of an eye before it is looked at, in eye widths, as standard deviations around
# FaceMesh's: its irises lag behind glances; up and down eyes go less far; its lids stand .03 off,
# and bend as it hardly tells. Its rings are a tenth smaller than the limbus (renders), and tremble
# by a twentieth. Most irises are seen a little from the side, at most from 40 degrees.
_SHAPE_WIDTH = np.array([0.12, 0.04, 0.06, 0.04, 0.05, 0.1, 0.04, 0.1])
_LIMBUS_BY_RING, _LOG_RADIUS_REACH = 1.1, 0.3
_OBLIQUE_USUAL, _OBLIQUE_BOUNDS = 0.95, (0.75, 1.0)
# Brightness, in shares of the patch's range: skin, skin, sclera, sclera and iris are free; a pupil
# is darker than its iris (in brown eyes hardly), lashes darken the upper lid, light has a side.
_COLOUR_WIDTH = np.array([1, 1, 1, 1, 1, 0.3, 0.1, 0.5])
_DARKER_PUPIL, _LASHES_LEVELS = -0.3, -10.0
# What of a patch is dark (iris), usual (skin) and bright (sclera), and how far it ranges.
_IRIS_PERCENT, _SKIN_PERCENT, _SCLERA_PERCENT, _RANGE_PERCENTS = 8, 50, 85, (5, 95)
_LEAST_RANGE = 8.0
# A pixel errs at least by so many of 255 levels: noise, compression. How much it does is measured
# from the second round on: 1.48 medians are a normal distribution's deviation. What is beyond two
# of these (highlights, a frame of glasses) counts ever less. Neighbouring samples err alike.
_NOISE_LEVELS, _NOISE_AT_FIRST, _DEVIATION_BY_MEDIAN = 4.0, 0.2, 1.48
_FAR_OFF, _SAMPLES_ALIKE = 2.0, 2.0
_ROUNDS, _MOST_STEP = 5, np.array([0.06, 0.06, 0.15, 0.1, 0.06, 0.15, 0.06, 0.15])
# How far a limbus reaches; and how much a large eye is blurred before it is sampled.
_SOFT_PX, _SOFT_LEAST, _BLUR_BY_STEP = 0.35, 0.015, 0.5
# An iris is seen where lids are open, where it is darker than the sclera by this share of the range
# and by so many levels, and where the fit's standard errors along and across the eye are below
# these eye widths.
_OPEN, _CONTRAST, _CONTRAST_LEVELS, _SURE = 0.25, 0.25, 10.0, np.array([0.03, 0.06])
# Shadows and lids are not quite as drawn: what errors are found to have beside the fit's own.
_OWN_ERROR = 0.008
# A precision that is none, and keeps what nothing tells from being infinite.
_NOTHING_EXPECTED = 1e-6


@dataclass(frozen=True)
class FoundIrises:
    """Middles of right irises and left ones, and how sure they are.

    `centers` have the unit of the landmarks they were found by; `sigma` are standard errors along
    the eye (corner to corner) and across it in eye widths, inf where no iris is seen.
    """

    centers: Float[np.ndarray, "*batch 2 2"]
    sigma: Float[np.ndarray, "*batch 2 2"]

    @property
    def found(self) -> Bool[np.ndarray, "*batch 2"]:
        """Which irises are seen."""
        return np.isfinite(self.sigma).all(-1)

    @classmethod
    def unseen(cls, landmarks_px: Float[np.ndarray, "*batch 478 2"]) -> "FoundIrises":
        """None of them seen, so that they are where FaceMesh guesses."""
        centers = landmarks_px[..., list(IRIS_CENTERS), :]
        return cls(centers, np.full_like(centers, np.inf))

    @classmethod
    def stacked(cls, each: "Sequence[FoundIrises]") -> "FoundIrises":
        """Those of several pictures."""
        return cls(
            np.array([one.centers for one in each]).reshape(-1, 2, 2),
            np.array([one.sigma for one in each]).reshape(-1, 2, 2),
        )

    def of(self, frames: Sequence[int]) -> "FoundIrises":
        """Those of these pictures of several."""
        return FoundIrises(self.centers[list(frames)], self.sigma[list(frames)])


@dataclass(frozen=True)
class _EyeAxes:
    """Both eyes' own coordinates: middles of the corners, pixels an eye width along and across."""

    middle_px: Float[np.ndarray, "2 2"]
    axes_px: Float[np.ndarray, "2 2 2"]
    """Columns are an eye width along and one across."""
    width_px: Float[np.ndarray, "2"]

    @classmethod
    def of(cls, landmarks_px: Float[np.ndarray, "478 2"]) -> "_EyeAxes":
        """Those between FaceMesh's corners of the eyes."""
        first, second = (landmarks_px[list(ends)] for ends in zip(*EYE_CORNERS))
        along = second - first
        across = np.stack([-along[:, 1], along[:, 0]], 1)
        width = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
        return cls((first + second) / 2, np.stack([along, across], 2), width)

    def into(self, points_px: Float[np.ndarray, "2 K 2"]) -> Float[np.ndarray, "2 K 2"]:
        """Pixels to eye widths."""
        away = points_px - self.middle_px[:, None]
        return away @ self.axes_px / np.square(self.width_px)[:, None, None]

    def out_of(self, points: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
        """Eye widths to pixels."""
        return self.middle_px + (self.axes_px @ points[..., None])[..., 0]

    def patch(
        self, red: Float[np.ndarray, "H W"], corner_px: tuple[int, int], eye: int
    ) -> Float[np.ndarray, "N"]:
        """An eye's samples, row by row, of a part of the picture that begins at `corner_px`."""
        step = self.axes_px[eye] * STEP
        first = np.array([(ACROSS - 1) / 2, (DOWN - 1) / 2])
        # OpenCV puts the centre of the first pixel at 0.
        origin = self.middle_px[eye] - step @ first - corner_px - 0.5
        mapping = np.concatenate([step, origin[:, None]], axis=1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        sampled = cv2.warpAffine(
            red, mapping, (ACROSS, DOWN), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return sampled.reshape(-1)


def find_irises(
    image_rgb: UInt8[np.ndarray, "H W 3"], landmarks_px: Float[np.ndarray, "478 2"]
) -> FoundIrises:
    """The middles of both irises in pixels, found between FaceMesh's corners of the eyes.

    Looks at red light, in which skin and sclera are bright and all irises dark. Where an eye is
    closed, blurred, behind a reflection or out of the picture, no iris is seen.
    """
    eyes = _EyeAxes.of(landmarks_px)
    unseen = FoundIrises.unseen(landmarks_px)
    are_open = irises_seen(landmarks_px) > _OPEN
    if not are_open.any() or not _within(image_rgb, eyes):
        return unseen
    patches = np.stack([_patch(image_rgb, eyes, eye) for eye in range(2)])
    soft = np.maximum(_SOFT_PX / eyes.width_px, _SOFT_LEAST)
    percents = (_IRIS_PERCENT, _SKIN_PERCENT, _SCLERA_PERCENT, *_RANGE_PERCENTS)
    *levels, low, high = np.percentile(patches, percents, axis=1)
    span = (high - low).clip(_LEAST_RANGE)
    start = _start(eyes, landmarks_px, np.stack(levels), span)
    fitted, variance = _fitted(patches, span, start, soft)
    sigma = np.sqrt(variance)
    darker = fitted[:, SCLERA].mean(1) - fitted[:, IRIS]
    plain = darker > np.maximum(_CONTRAST * span, _CONTRAST_LEVELS)
    seen = are_open & plain & (sigma < _SURE).all(1)
    sigma = np.where(seen[:, None], np.hypot(sigma, _OWN_ERROR), np.inf)
    centers = np.where(seen[:, None], eyes.out_of(fitted[:, CENTER]), unseen.centers)
    return FoundIrises(centers, sigma)


def _within(image_rgb: UInt8[np.ndarray, "H W 3"], eyes: _EyeAxes) -> bool:
    """Whether the picture reaches from eye to eye."""
    height, width = image_rgb.shape[:2]
    middle = eyes.middle_px
    return bool(((middle >= 0) & (middle < (width, height))).all() and (eyes.width_px > 1).all())


def _patch(
    image_rgb: UInt8[np.ndarray, "H W 3"], eyes: _EyeAxes, eye: int
) -> Float[np.ndarray, "N"]:
    """Red light of an eye, averaged where a sample stands for several pixels."""
    height, width = image_rgb.shape[:2]
    reach = eyes.width_px[eye]
    low = np.floor(eyes.middle_px[eye] - reach).astype(int).clip(0)
    high = np.ceil(eyes.middle_px[eye] + reach).astype(int).clip(None, (width, height))
    red = image_rgb[low[1] : high[1], low[0] : high[0], 0].astype(np.float32)
    pixels_a_step = float(eyes.width_px[eye]) * STEP
    if pixels_a_step > 1:
        red = cv2.GaussianBlur(red, (0, 0), _BLUR_BY_STEP * pixels_a_step)
    return eyes.patch(red, (int(low[0]), int(low[1])), eye)


def _start(
    eyes: _EyeAxes,
    landmarks_px: Float[np.ndarray, "478 2"],
    levels: Float[np.ndarray, "3 2"],
    span: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "2 16"]:
    """The eyes as FaceMesh sees them, with the brightness of iris, skin and sclera."""
    start = np.zeros((2, PARAMETERS))
    centers, rims = landmarks_px[list(IRIS_CENTERS)], landmarks_px[np.array(IRIS_RIMS)]
    ring_px = np.linalg.norm(rims - centers[:, None], axis=-1).mean(1)
    start[:, CENTER] = eyes.into(centers[:, None])[:, 0]
    start[:, LOG_RADIUS] = np.log(_LIMBUS_BY_RING * (ring_px / eyes.width_px).clip(1e-3))
    start[:, OBLIQUE] = _OBLIQUE_USUAL
    for part, lid in zip((UPPER_LID, LOWER_LID), zip(*LID_PAIRS)):
        start[:, part] = _lids(eyes.into(landmarks_px[np.array(lid)].reshape(2, -1, 2)))
    start[:, IRIS], start[:, SKIN], start[:, SCLERA] = levels[0], levels[1:2].T, levels[2:].T
    start[:, PUPIL], start[:, LASHES] = _DARKER_PUPIL * span, _LASHES_LEVELS
    return start


def _lids(points: Float[np.ndarray, "2 K 2"]) -> Float[np.ndarray, "2 2"]:
    """Height and bend of the lids that go through these points."""
    along, below = points[..., :1], points[..., 1:]
    opening = 1 - 4 * along**2
    courses = np.concatenate([opening, opening * along], axis=2)
    across = courses.transpose(0, 2, 1)
    # Points of one place, as only damaged landmarks have them, say nothing of the bend.
    normal = across @ courses + _NOTHING_EXPECTED * np.eye(2)
    return np.linalg.solve(normal, across @ below)[..., 0]


def _fitted(
    patches: Float[np.ndarray, "2 N"],
    span: Float[np.ndarray, "2"],
    start: Float[np.ndarray, "2 16"],
    soft: Float[np.ndarray, "2"],
) -> tuple[Float[np.ndarray, "2 16"], Float[np.ndarray, "2 2"]]:
    """The most likely eyes, by robust Gauss-Newton steps from `start`, which is what is expected.

    Second: variance of the iris's middle along and across, as the picture alone tells it.
    """
    shape_width = np.broadcast_to(_SHAPE_WIDTH, (2, len(_SHAPE_WIDTH)))
    widths = np.concatenate([shape_width, _COLOUR_WIDTH * span[:, None]], axis=1)
    expected = np.eye(PARAMETERS) * (widths**-2.0)[:, None]
    least, most = start[:, LOG_RADIUS] - _LOG_RADIUS_REACH, start[:, LOG_RADIUS] + _LOG_RADIUS_REACH
    noise = np.maximum(_NOISE_AT_FIRST * span, _NOISE_LEVELS)
    eyes, told, pull = start, *_evidence(patches, start, soft, noise)
    for _ in range(_ROUNDS):
        step = np.linalg.solve(told + expected, (pull + (start - eyes) / widths**2)[..., None])[
            ..., 0
        ]
        share = (_MOST_STEP / np.maximum(np.abs(step[:, SHAPE]), 1e-9)).min(1).clip(None, 1)
        eyes = eyes + step * share[:, None]
        eyes[:, LOG_RADIUS] = eyes[:, LOG_RADIUS].clip(least, most)
        eyes[:, OBLIQUE] = eyes[:, OBLIQUE].clip(*_OBLIQUE_BOUNDS)
        told, pull = _evidence(patches, eyes, soft, None)
    expected[:, [0, 1], [0, 1]] = _NOTHING_EXPECTED
    variance = np.linalg.inv(told + expected)[:, [0, 1], [0, 1]]
    return eyes, variance


def _evidence(
    patches: Float[np.ndarray, "2 N"],
    eyes: Float[np.ndarray, "2 16"],
    soft: Float[np.ndarray, "2"],
    known_noise: Float[np.ndarray, "2"] | None,
) -> tuple[Float[np.ndarray, "2 16 16"], Float[np.ndarray, "2 16"]]:
    """Precision and gradient that the pictures add.

    Without known noise it is measured, and what is far off counts less.
    """
    drawn, slopes = drawn_eye(eyes, soft)
    away = patches - drawn
    if known_noise is None:
        typical = _DEVIATION_BY_MEDIAN * np.median(np.abs(away), axis=1)
        noise = np.maximum(typical, _NOISE_LEVELS)[:, None]
        trust = 1 / (1 + np.square(away / (_FAR_OFF * noise))) ** 2
    else:
        noise, trust = known_noise[:, None], np.ones_like(away)
    weighted = slopes * (trust / (_SAMPLES_ALIKE * noise**2))[:, None]
    return weighted @ slopes.transpose(0, 2, 1), (weighted @ away[..., None])[..., 0]
