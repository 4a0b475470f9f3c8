"""The person's outline in the key frames, which the fit asks for before there are any crops."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.reading import DamagedFileError, load_arrays
from rgbavatar_ns.tracking.face.clip import ClipLandmarks
from rgbavatar_ns.tracking.fit.outline import PersonOutline
from rgbavatar_ns.tracking.image.crop import SquareCrop, steady_crop
from rgbavatar_ns.tracking.image.matting import PersonMatte
from rgbavatar_ns.tracking.input.mattes import UserMattes, given_mattes
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.resumable_run import GO_ON, ResumableRun, stage_damage_told

OUTLINE_PX = 256
"""Side of the crops that outlines are found in: segmentation knows no more."""
# A matte that holds less of the face than this is of something else, or of nothing; given mattes of
# which most hold even less are no film's of this person.
_OF_FACE, _LEAST_OF_FACE = 0.8, 0.25
_MOST_BYTES = 1 << 28


def person_outline(
    matte: UInt8[np.ndarray, "s s"], crop: SquareCrop, landmarks_px: Float[np.ndarray, "478 2"]
) -> PersonOutline | None:
    """The outline of whom the face belongs to, of a matte's crop; None where it misses the face.

    Holes are filled and what stands apart is left out: only where the person ends is asked.
    """
    solid = (matte > 127).astype(np.uint8)
    face = _face(crop, landmarks_px)
    contours, _ = cv2.findContours(solid, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    person, most = np.zeros_like(solid), 0
    for contour in contours:
        filled = cv2.drawContours(np.zeros_like(solid), [contour], 0, (1,), cv2.FILLED)
        shared = int(np.sum(filled * face))
        if shared > most:
            person, most = filled, shared
    if most == 0 or most < _OF_FACE * face.sum() or person.all():
        return None
    outwards, inwards = (_distances(part) for part in (1 - person, person))
    step_px = 1 / crop.scale
    # Distances are to the nearest pixel of the other kind; the edge lies half a pixel before it.
    away = np.where(person > 0, 0.5 - inwards, outwards - 0.5)
    first_px = np.array([crop.left, crop.top]) + 0.5 * step_px
    return PersonOutline(away * step_px, first_px, step_px)


def _face(crop: SquareCrop, landmarks_px: Float[np.ndarray, "478 2"]) -> UInt8[np.ndarray, "s s"]:
    """1 where the face is, within the hull of its landmarks."""
    hull = cv2.convexHull(crop.points(landmarks_px).astype(np.float32))
    none = np.zeros((crop.size, crop.size), np.uint8)
    return cv2.fillConvexPoly(none, np.round(hull - 0.5).astype(np.int32), (1,))


def _require_faces(
    kept: UInt8[np.ndarray, "K s s"], faces: Sequence[UInt8[np.ndarray, "s s"]], given: str
) -> None:
    """UserError where most of the mattes that were given leave the face out."""
    held = [(matte > 127)[face > 0].mean() for matte, face in zip(kept, faces) if face.any()]
    if held and np.median(held) < _LEAST_OF_FACE:
        raise UserError(
            f"{given} leave the face out: they hold {np.median(held):.0%} of it.",
            "White (or opaque) is the person: turn inverted mattes round. Others are perhaps of "
            "another film, or in another order.",
        )


def _distances(part: UInt8[np.ndarray, "s s"]) -> Float[np.ndarray, "s s"]:
    """How far each pixel is from the nearest one that is 0.

    OpenCV's differ in the last digits from call to call; their squares are whole numbers.
    """
    found = cv2.distanceTransform(part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.sqrt(np.rint(np.square(found.astype(np.float64))))


def key_outlines(
    source: FrameSource,
    mattes: UserMattes | None,
    source_alpha: bool,
    found: ClipLandmarks,
    positions: Sequence[int],
    run: ResumableRun,
    advance: Callable[[int], None] = lambda frames: None,
) -> list[PersonOutline | None]:
    """The outlines in these frames, from the user's own mattes, the source's alpha, or found.

    The frames are read once more, and `advance` is told how many; what was found is kept in `run`.
    Raises UserError where most of the mattes that were given leave the face out.
    """
    crop = steady_crop(found.points_px, found.width, found.height, OUTLINE_PX)
    place = {found.frame_index[position]: position for position in positions}
    path = run.folder / "key_mattes.npz"

    def look(key: str) -> dict[str, Any]:
        advance(0)
        made = dict(_mattes(source, mattes, source_alpha, found, frozenset(place), crop, advance))
        with atomic_write(path, remedy=GO_ON) as partial:
            np.savez(partial, matte=np.stack([made[index] for index in sorted(place)]))
        return {"file": path.name}

    made_from = [sorted(place), crop.left, crop.top, crop.side]
    run.stages.run("mattes of key frames", made_from, look)
    advance(found.frames_read)
    with stage_damage_told(path, "mattes of key frames"):
        kept = load_arrays(path, _MOST_BYTES)["matte"]
        if kept.shape != (len(place), OUTLINE_PX, OUTLINE_PX) or kept.dtype != np.uint8:
            raise DamagedFileError("its arrays do not fit together")
    landmarks_px = [found.points_px[place[index]] for index in sorted(place)]
    if mattes is not None or source_alpha:
        given = "The mattes of the film's alpha channel"
        if mattes is not None:
            given = f"The mattes in {mattes.path}"
        _require_faces(kept, [_face(crop, points) for points in landmarks_px], given)
    return [person_outline(matte, crop, points) for matte, points in zip(kept, landmarks_px)]


def _mattes(
    source: FrameSource,
    mattes: UserMattes | None,
    source_alpha: bool,
    found: ClipLandmarks,
    wanted: frozenset[int],
    crop: SquareCrop,
    advance: Callable[[int], None],
) -> Iterator[tuple[int, UInt8[np.ndarray, "s s"]]]:
    """The mattes' crops, in the frames' order."""
    if mattes is not None:
        for index, level in mattes.levels(wanted, found.width, found.height):
            yield index, crop.apply(level)
        return
    last = max(wanted)

    def read(index: int) -> bool:
        advance(index + 1)
        return index in wanted

    with closing(PersonMatte()) as matte:
        for frame, given in given_mattes(source.read(read), wanted, None, source_alpha):
            if given is not None:
                yield frame.index, crop.apply(given)
            else:
                yield frame.index, levels(matte(crop.apply(frame.image_rgb)))
            if frame.index == last:
                return


def levels(matte: Float[np.ndarray, "s s"]) -> UInt8[np.ndarray, "s s"]:
    """A matte in [0, 1] as bytes."""
    return (matte * 255 + 0.5).astype(np.uint8)
