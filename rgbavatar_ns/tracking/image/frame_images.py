"""The second reading of a clip: crops and mattes of the tracked frames."""

from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.data.check.sample import spread
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.drawing.compositing import unfilmed_pixels
from rgbavatar_ns.tracking.face.clip import ClipLandmarks
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.image.background import (
    Background,
    find_background,
    sampled_positions,
)
from rgbavatar_ns.tracking.image.body_end import BodyEnd
from rgbavatar_ns.tracking.image.crop import SquareCrop
from rgbavatar_ns.tracking.image.cut_out import CutOut, MattedCrop
from rgbavatar_ns.tracking.image.hair import HairColors, hair_pixels
from rgbavatar_ns.tracking.image.head_mask import HeadOutline
from rgbavatar_ns.tracking.image.known_room import KnownRoom
from rgbavatar_ns.tracking.image.matting import PersonMatte, refined_matte
from rgbavatar_ns.tracking.image.steady_matte import NEIGHBOURS, CoarseMatte, head_motion, steadied
from rgbavatar_ns.tracking.image.unsure_band import band_matte
from rgbavatar_ns.tracking.input.mattes import UserMattes, given_mattes
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.threads import InBackground, map_in_order

_AHEAD, _WORKERS = 2, 2
# No edge is sharper than the film's own: an avatar would learn how it flickers. A found matte's
# edges are so wide by themselves, and so are those that a renderer draws; by what the film's are
# wider they are softened, and a quarter more: held-out frames of two real clips, which come to .9
# pixels, lose 2.3 dB without, and one of them .4 and 1.1 dB with .7 and .5.
_MATTE_EDGE_PX, _MORE, _SOFTEST_PX = 0.65, 1.25, 1.0
# Where no edge tells, as wide as a webcam's.
_UNKNOWN_EDGE_PX = 1.0
# So many frames tell where the body ends.
_BODY_END_FRAMES = 64


def _softness_px(background: Background | None) -> float:
    """By how wide a Gaussian a found matte is softened; 0 where the film is as sharp as it is."""
    edge_px = None if background is None else background.edge_px
    wider = max((edge_px or _UNKNOWN_EDGE_PX) ** 2 - _MATTE_EDGE_PX**2, 0)
    return min(_MORE * float(np.sqrt(wider)), _SOFTEST_PX)


@dataclass(frozen=True)
class TrackedImage:
    """One tracked frame's image as a PNG file's bytes; `position` counts tracked frames."""

    position: int
    png: bytes
    outline: HeadOutline
    matte: Float[np.ndarray, "s s"]
    """What the matte holds of the whole person, as small as the outline."""
    inside: Float[np.ndarray, "s s"]
    """1 where the crop shows the frame."""
    unfilmed: float
    """Share of the image that is marked: beyond the frame, where the head may be."""


@dataclass(frozen=True)
class _Cropped:
    """A crop on its way: with its alpha if the user gave one, else with the coarse matte."""

    position: int
    image_rgb: UInt8[np.ndarray, "S S 3"]
    alpha: Float[np.ndarray, "S S"] | None
    color_is_clean: bool = False
    coarse: Float[np.ndarray, "S S"] | None = None
    small: CoarseMatte | None = None


@dataclass(frozen=True)
class _Known:
    """What the look at the background has told, as every frame's matte needs it."""

    room: KnownRoom | None
    softness_px: float

    @classmethod
    def of(cls, background: Background | None, inside: Bool[np.ndarray, "S S"]) -> "_Known":
        room = None if background is None else KnownRoom.of(background, inside)
        return cls(room, _softness_px(background))


_Window = tuple[_Cropped, tuple[_Cropped, ...]]


class FrameImages:
    """Makes tracked frames' images: crop, matte, colour at soft edges, an end at the neck or
    the chest.

    Mattes are the user's own (`mattes`), or the alpha channel of the source where
    `source_alpha`, or found. Reading, segmentation and the rest run in threads of their own; a
    few frames are in memory at a time. Each image depends on the clip, the fit and the background
    alone. `body_end` is where the body ends, by frames spread over the clip; None without a body.
    """

    def __init__(
        self,
        tracker: SubjectTracker,
        fit: ClipFit,
        found: ClipLandmarks,
        crop: SquareCrop,
        mattes: UserMattes | None = None,
        source_alpha: bool = False,
    ) -> None:
        self._tracker, self._fit, self._found, self._crop = tracker, fit, found, crop
        self._mattes, self._source_alpha = mattes, source_alpha
        self._inside = crop.inside(found.width, found.height)
        self.body_end = self._found_body_end()
        self._cut_out = CutOut(tracker.head.arrays, self.body_end)
        self._follows = found.follows()

    def _found_body_end(self) -> BodyEnd | None:
        arrays = self._tracker.head.arrays
        if not arrays.has_torso:
            return None
        some = [self._vertices_px(k) for k in spread(len(self._found), _BODY_END_FRAMES).tolist()]
        return BodyEnd.of(arrays, some, self._inside)

    def _vertices_px(self, position: int) -> Float[np.ndarray, "V 2"]:
        return self._crop.points(self._tracker.vertices_px(self._fit, position))

    def _landmarks_px(self, position: int) -> Float[np.ndarray, "L 2"]:
        return self._crop.points(self._found.points_px[position])

    @property
    def finds_mattes(self) -> bool:
        """Whether mattes are found here, and not given."""
        return self._mattes is None and not self._source_alpha

    def background(self, source: FrameSource, done: Callable[[int], None]) -> Background:
        """What is behind the person, from frames spread over the clip; `done` counts them."""
        positions = sampled_positions(len(self._found), self._crop.size)
        hair: list[UInt8[np.ndarray, "N 3"]] = []

        def looked_at() -> Iterator[tuple[np.ndarray, np.ndarray]]:
            for count, crop in enumerate(segmented, 1):
                assert crop.coarse is not None
                matte = refined_matte(crop.image_rgb, crop.coarse)
                face_px = self._landmarks_px(crop.position)
                hair.append(hair_pixels(crop.image_rgb, matte, face_px, self._inside))
                yield crop.image_rgb, matte
                done(count)

        with ExitStack() as closed:
            crops = InBackground(self._crops(source, positions), _AHEAD)
            closed.enter_context(closing(crops))
            segmented = InBackground(self._segmented(crops), _AHEAD)
            closed.enter_context(closing(segmented))
            found = find_background(looked_at(), self._inside)
        if found.plate is None:
            return found
        room, known = found.plate.color, found.plate.known
        return replace(found, hair=HairColors.of(np.concatenate(hair), room, known, self._inside))

    def __call__(
        self,
        source: FrameSource,
        background: Background | None = None,
        without: Collection[int] = (),
    ) -> Generator[TrackedImage, None, None]:
        """The image of every tracked frame, in order, but for the positions in `without`.

        The `background`'s plate, if it has one, tells the person from the room.
        """
        there = frozenset(without)
        wanted = [k for k in range(len(self._found)) if k not in there]
        read = sorted({near for k in wanted for near in self._window(k)})
        if not wanted:
            return
        with ExitStack() as closed:
            crops = InBackground(self._crops(source, read), _AHEAD)
            closed.enter_context(closing(crops))
            segmented = InBackground(self._segmented(crops), _AHEAD)
            closed.enter_context(closing(segmented))
            windows = self._windows(segmented, frozenset(wanted))
            finish = partial(self._finish, _Known.of(background, self._inside))
            yield from closed.enter_context(closing(map_in_order(finish, windows, _WORKERS)))

    def _window(self, position: int) -> range:
        """Positions around this one whose frames come directly before and after it."""
        first = last = position
        if not self.finds_mattes:
            return range(first, last + 1)
        while first > position - NEIGHBOURS and self._follows[first]:
            first -= 1
        while (
            last < position + NEIGHBOURS
            and last + 1 < len(self._follows)
            and self._follows[last + 1]
        ):
            last += 1
        return range(first, last + 1)

    def _crops(self, source: FrameSource, positions: list[int]) -> Iterator[_Cropped]:
        place = {self._found.frame_index[k]: k for k in positions}
        wanted = frozenset(place)
        frames = source.these(wanted)
        for frame, given in given_mattes(frames, wanted, self._mattes, self._source_alpha):
            position, crop = place[frame.index], self._crop
            if self._source_alpha and frame.alpha is not None:
                yield _Cropped(position, *crop.matted(frame.image_rgb, frame.alpha), True)
            else:
                alpha = None if given is None else crop.apply(given).astype(np.float32) / 255
                yield _Cropped(position, crop.apply(frame.image_rgb), alpha)

    def _segmented(self, crops: Iterable[_Cropped]) -> Iterator[_Cropped]:
        matte = None
        try:
            for crop in crops:
                if crop.alpha is not None:
                    yield crop
                    continue
                matte = matte or PersonMatte()
                face_px = self._landmarks_px(crop.position)
                coarse = matte.coarse_with_face(crop.image_rgb, face_px)
                small = CoarseMatte.of(crop.image_rgb, coarse)
                yield replace(crop, coarse=coarse, small=small)
        finally:
            if matte is not None:
                matte.close()

    def _windows(self, crops: Iterable[_Cropped], wanted: frozenset[int]) -> Iterator[_Window]:
        """Each wanted crop with those around it, as soon as the last of them is there."""
        held: deque[_Cropped] = deque()
        waiting: deque[int] = deque()
        for crop in crops:
            held.append(crop)
            if crop.position in wanted:
                waiting.append(crop.position)
            while waiting and self._window(waiting[0])[-1] <= crop.position:
                position = waiting.popleft()
                around = self._window(position)
                window = tuple(one for one in held if one.position in around)
                yield next(one for one in window if one.position == position), window
            needed = self._window(waiting[0])[0] if waiting else crop.position - NEIGHBOURS
            while held and held[0].position < needed:
                held.popleft()

    def _finish(self, known: _Known, window: _Window) -> TrackedImage:
        crop, around = window
        if crop.alpha is not None:
            matted = MattedCrop.of(crop.image_rgb, crop.alpha, self._inside, crop.color_is_clean)
        else:
            coarse = self._steadied(crop, around)
            room = None if known.room is None else known.room.behind(crop.image_rgb, coarse)
            colors, hair = (None, None) if room is None else (room.colors, room.hair)
            found = band_matte(crop.image_rgb, coarse, colors, hair)
            alpha = found.alpha
            if known.softness_px > 0:
                alpha = cv2.GaussianBlur(alpha, (0, 0), known.softness_px)
            matted = MattedCrop.of(crop.image_rgb, alpha, self._inside, background=found.background)
        vertices_px = self._vertices_px(crop.position)
        landmarks_px = self._landmarks_px(crop.position)
        outline = self._cut_out.outline(self._crop.size, vertices_px, landmarks_px)
        matte, inside = (
            cv2.resize(part, outline.silhouette.shape, interpolation=cv2.INTER_AREA)
            for part in (matted.alpha, self._inside.astype(np.float32))
        )
        image = self._cut_out(matted, outline, vertices_px)
        unfilmed = float(unfilmed_pixels(image).mean())
        png = encode_png_rgba(image)
        return TrackedImage(crop.position, png, outline, matte, inside, unfilmed)

    def _steadied(self, crop: _Cropped, around: tuple[_Cropped, ...]) -> Float[np.ndarray, "S S"]:
        assert crop.coarse is not None
        assert crop.small is not None
        now = self._landmarks_px(crop.position)
        near = [
            (other.small, head_motion(self._landmarks_px(other.position), now))
            for other in around
            if other.small is not None and other.position != crop.position
        ]
        return steadied(crop.coarse, crop.small, near)
