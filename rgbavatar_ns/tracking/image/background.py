"""What is behind the person: a clean plate of it, where the camera stands or a hand moves it."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float16, UInt8

from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.reading import DamagedFileError, load_arrays
from rgbavatar_ns.tracking.image.hair import HairColors
from rgbavatar_ns.tracking.image.room_view import RoomView, laid_on
from rgbavatar_ns.tracking.image.sharpness import edge_width_px
from rgbavatar_ns.tracking.resumable_run import stage_damage_told

_MOST_BYTES = 1 << 32
SAMPLES = 40
"""Frames that are looked at, spread over the clip: each pixel's median needs no more."""
# Of a very large image fewer are held at once.
_SAMPLES_BYTES, _FEWEST = 256 * 2**20, 8
# A pixel counts as uncovered in a frame whose matte is below this.
_UNCOVERED = 0.3
# A plate's colour is known where so many frames show it, and agree to so many levels (0 to 255).
_SEEN, _AGREE_LEVELS = 4, 6.0
# What lies farther from the person than this share of the image is surely none of it, and tells of
# motion by itself where it is so large a part of the image.
_WELL_AWAY, _AWAY_SHARE = 0.08, 0.1
# A matte has lost the person where it holds less than this share of what the median one does.
_LOST_SHARE = 0.5
# Sorting is done by so many rows at a time, so that little is held beside the samples.
_ROWS = 32
_QUARTILE_SIGMAS = 1.349
# A pixel tells of motion where the plate changes by so many levels from one pixel to the next, and
# the clip is told by it where a pixel in two hundred does.
_TEXTURE_LEVELS, _TEXTURE_SHARE = 8.0, 0.005
# The camera moves where what it shows wanders by more (one standard deviation, pixels of the crop):
# less blurs the plate no more than interpolation does.
_STILL_PX = 0.5
# The light changes where one frame in ten is off by more levels; less is followed frame by frame.
_LIGHT_LEVELS, _LIGHT_PERCENTILE = 10.0, 90
# A moving camera's frames are laid on one another by what lies farther from the person than this
# share of the image, where so many of them can be.
_CLEAR, _LAID_SHARE = 0.03, 0.75
# Their edges are off by so many pixels.
_LAID_OFF_PX = 0.4

BackgroundKind = Literal["still", "moves", "light changes", "covered", "too short"]


@dataclass(frozen=True)
class CleanPlate:
    """The room without the person, as far as the clip uncovers it."""

    color: UInt8[np.ndarray, "S S 3"]
    """Black where nothing is known."""
    seen: UInt8[np.ndarray, "S S"]
    """In how many of the sampled frames each pixel was background; 0 where these disagree."""
    spread: Float[np.ndarray, "S S"]
    """One standard deviation over time, levels of the worst channel."""

    @property
    def known(self) -> Bool[np.ndarray, "S S"]:
        """Where enough frames agree."""
        return self.seen >= _SEEN

    @property
    def moves(self) -> Bool[np.ndarray, "S S"]:
        """Where something is seen that no segmentation takes for the person, and frames differ."""
        return ~self.known & (self.spread >= _AGREE_LEVELS)


@dataclass(frozen=True)
class Background:
    """What a clip's background does, and the plate if it is of use.

    The plate of a camera that moves is what one picture would show: `RoomView` finds it in others.
    """

    kind: BackgroundKind
    motion_px: float | None
    """How far it wanders (one standard deviation, pixels of the crop); None without texture."""
    light_levels: float
    """How far frames are brighter or darker than the clip's median, of 255 (percentile 90)."""
    plate: CleanPlate | None
    edge_px: float | None = None
    """How wide the film's sharp edges are (`sharpness.py`, the median frame); None without any."""
    hair: HairColors | None = None
    """How to tell the person's hair from the room; None without a plate, or with too little of
    either to tell."""

    @property
    def camera_is_still(self) -> bool | None:
        """Whether the camera stands; None where nothing behind the person would tell."""
        if self.kind in ("covered", "too short") or self.motion_px is None:
            return None
        return self.kind != "moves"

    def report(self) -> dict[str, Any]:
        """What `tracking.json` says of it."""
        known = None if self.plate is None else float(self.plate.known.mean())
        return {
            "background": self.kind,
            "camera_is_still": self.camera_is_still,
            "background_motion_px": self.motion_px,
            "background_light_levels": self.light_levels,
            "background_known_share": known,
            "film_edge_px": self.edge_px,
        }

    def save(self, path: Path, remedy: str) -> None:
        """Write everything to a file of NumPy's."""
        plate = {}
        if self.plate is not None:
            plate = {name: getattr(self.plate, name) for name in ("color", "seen", "spread")}
        motion, edge = (
            np.nan if value is None else value for value in (self.motion_px, self.edge_px)
        )
        with atomic_write(path, remedy=remedy) as partial, partial.open("wb") as file:
            held = {**plate, **({} if self.hair is None else asdict(self.hair))}
            np.savez(
                file, kind=self.kind, motion=motion, edge=edge, light=self.light_levels, **held
            )

    @classmethod
    def load(cls, path: Path) -> "Background":
        """What `save` wrote; UserError where the file holds anything else."""
        with stage_damage_told(path, "background that was found"):
            held, plate = load_arrays(path, _MOST_BYTES), None
            kind = held["kind"].item()
            motion, edge = (
                None if np.isnan(value) else value
                for value in (float(held["motion"]), float(held["edge"]))
            )
            if kind not in get_args(BackgroundKind):
                raise DamagedFileError("its kind of background is none")
            if "color" in held:
                color, seen, spread = (held[name] for name in ("color", "seen", "spread"))
                if not color.shape[:2] == seen.shape == spread.shape:
                    raise DamagedFileError("its arrays do not fit together")
                plate = CleanPlate(color, seen, spread)
            told = "hair" in held or "room" in held
            hair = HairColors(held["hair"], held["room"]).checked() if told else None
            return cls(kind, motion, float(held["light"]), plate, edge, hair)


def sampled_positions(count: int, size: int) -> list[int]:
    """Which of `count` frames of `size` x `size` pixels are looked at."""
    held = max(_FEWEST, min(SAMPLES, _SAMPLES_BYTES // (3 * size * size)))
    return np.unique(np.linspace(0, count - 1, min(count, held)).round().astype(int)).tolist()


def find_background(
    samples: Iterable[tuple[UInt8[np.ndarray, "S S 3"], Float[np.ndarray, "S S"]]],
    inside: Bool[np.ndarray, "S S"],
) -> Background:
    """Judge the background by (image, matte of the person) of frames spread over a clip.

    Each pixel's colour is the median over the frames that have the person well away from it, or
    the farthest away that there are, which a matte's errors leave alone as long as most of these
    frames are right there. `inside` is where the images show what was filmed.
    """
    images, clear_px, edges = [], [], []
    for image, matte in samples:
        images.append(image)
        edges.append(edge_width_px(image, matte))
        clear_px.append(_clear_of_person(matte) * inside)
    told = [edge for edge in edges if edge is not None]
    edge_px = float(np.median(told)) if told else None
    if len(images) < _FEWEST:
        return Background("too short", None, 0.0, None, edge_px)
    clear_px = _of_whole_mattes(clear_px, inside)
    look = _Look.at(images, clear_px)
    kind, motion_px = look.kind, look.motion_px
    if kind == "moves" and _lay_on_one(images, clear_px):
        laid = _Look.at(images, clear_px)
        if laid.kind == "still":
            plate = laid.plate(_LAID_OFF_PX)
            return Background("moves", motion_px, laid.light_levels, plate, edge_px)
    plate = look.plate(0.0) if kind == "still" else None
    return Background(kind, motion_px, look.light_levels, plate, edge_px)


@dataclass(frozen=True)
class _Look:
    """What the samples tell of the room, pixel by pixel."""

    color: UInt8[np.ndarray, "S S 3"]
    spread: Float[np.ndarray, "S S"]
    count: UInt8[np.ndarray, "S S"]
    """How many frames counted."""
    away: Bool[np.ndarray, "S S"]
    """Where enough frames have the person well away."""
    light_levels: float
    motion_px: float | None

    @classmethod
    def at(cls, images: list[np.ndarray], clear_px: list[Float16[np.ndarray, "S S"]]) -> "_Look":
        """Of images and how far each pixel lies from the person there."""
        free, away = _farthest(clear_px)
        color, spread, count = _medians(images, free)
        often = count >= _SEEN
        light = _light_changes(images, free, color, often)
        motion = _motion_px(color, spread, away if away.mean() >= _AWAY_SHARE else often)
        return cls(color, spread, count, away, light, motion)

    @property
    def kind(self) -> BackgroundKind:
        """What the background does."""
        if (self.count >= _SEEN).mean() < _TEXTURE_SHARE:
            return "covered"
        if self.light_levels > _LIGHT_LEVELS:
            return "light changes"
        moves = self.motion_px is not None and self.motion_px > _STILL_PX
        return "moves" if moves else "still"

    def plate(self, off_px: float) -> CleanPlate:
        """The room as far as these frames agree on it, whose edges may be off by some pixels."""
        agree = self.spread < _AGREE_LEVELS + off_px * _steep(self.color)
        agree &= self.count >= _SEEN
        known = _hanging_together(agree, self.away)
        return CleanPlate(self.color, np.where(known, self.count, 0).astype(np.uint8), self.spread)


def room_shown(matte: Float[np.ndarray, "S S"], inside: Bool[np.ndarray, "S S"]) -> np.ndarray:
    """Where an image surely shows the room: `inside` what was filmed, and clear of the person."""
    return inside & (_clear_of_person(matte) > _CLEAR * len(matte))


def _lay_on_one(images: list[np.ndarray], clear_px: list[Float16[np.ndarray, "S S"]]) -> bool:
    """Lay all images, in their place, on one from the clip's middle as far as the room tells how.

    Those that cannot be laid count nowhere. False, and all as before, where these are too many.
    """
    shown = [clear > _CLEAR * len(clear) for clear in clear_px]
    from_middle = sorted(range(len(images)), key=lambda place: abs(place - len(images) // 2))
    views = (RoomView.of(images[place], shown[place]) for place in from_middle)
    view = next((view for view in views if view is not None), None)
    if view is None:
        return False
    found = [view.found_in(image, room) for image, room in zip(images, shown)]
    if sum(one is not None for one in found) < max(_FEWEST, _LAID_SHARE * len(images)):
        return False
    for place, sight in enumerate(found):
        if sight is None:
            clear_px[place] = np.zeros_like(clear_px[place])
        else:
            clear, to_it = clear_px[place].astype(np.float32), sight.homography
            images[place] = laid_on(images[place], to_it, cv2.INTER_CUBIC)
            clear = laid_on(clear, to_it, cv2.INTER_LINEAR) * ~sight.elsewhere
            clear_px[place] = clear.astype(np.float16)
    return True


def _clear_of_person(matte: Float[np.ndarray, "S S"]) -> Float16[np.ndarray, "S S"]:
    """How far each pixel lies from what a matte takes for the person, pixels; 0 on the person."""
    uncovered = (matte <= _UNCOVERED).astype(np.uint8)
    if uncovered.all():
        return np.full(matte.shape, len(matte), np.float16)
    return cv2.distanceTransform(uncovered, cv2.DIST_L2, 5).astype(np.float16)


def _of_whole_mattes(
    clear_px: list[Float16[np.ndarray, "S S"]], inside: Bool[np.ndarray, "S S"]
) -> list[Float16[np.ndarray, "S S"]]:
    """The same, 0 all over where a matte has lost the person: all frames here show one.

    What nobody filmed, 0 too, is not the person.
    """
    areas = [float((clear[inside] == 0).sum()) for clear in clear_px]
    least = _LOST_SHARE * np.median(areas)
    return [clear * (area >= least) for clear, area in zip(clear_px, areas)]


def _farthest(
    clear_px: list[Float16[np.ndarray, "S S"]],
) -> tuple[list[Bool[np.ndarray, "S S"]], Bool[np.ndarray, "S S"]]:
    """For each pixel the frames that count: with the person well away, or else the farthest few.

    What a segmentation misses in every frame, the brim of a hat, lies close to what it finds. Also
    returns where enough frames have the person well away.
    """
    margin = _WELL_AWAY * len(clear_px[0])
    enough = min(_SEEN, len(clear_px))
    least = np.zeros_like(clear_px[0])
    for top in range(0, len(least), _ROWS):
        rows = slice(top, top + _ROWS)
        sizes = np.stack([clear[rows] for clear in clear_px])
        least[rows] = np.partition(sizes, -enough, axis=0)[-enough]
    counts = np.clip(least, np.finfo(least.dtype).tiny, margin)
    return [clear >= counts for clear in clear_px], least >= margin


def _hanging_together(
    known: Bool[np.ndarray, "S S"], away: Bool[np.ndarray, "S S"]
) -> Bool[np.ndarray, "S S"]:
    """What is known as far as it hangs together with what is surely room; all of it without such.

    Islands in the person's outline are what every matte leaves out of it.
    """
    _, piece = cv2.connectedComponents(known.astype(np.uint8), connectivity=4)
    reaching = np.unique(piece[away & known])
    return np.isin(piece, reaching) if len(reaching) else known


def _medians(
    images: list[np.ndarray], free: list[np.ndarray]
) -> tuple[UInt8[np.ndarray, "S S 3"], Float[np.ndarray, "S S"], UInt8[np.ndarray, "S S"]]:
    """Median colour, spread and number of the frames that count, for each pixel."""
    color = np.zeros_like(images[0])
    spread = np.zeros(color.shape[:2], np.float32)
    count = np.sum(free, axis=0, dtype=np.uint8)
    for top in range(0, len(color), _ROWS):
        rows = slice(top, top + _ROWS)
        levels = np.stack([image[rows] for image in images], -1).astype(np.int16)
        counts = np.stack([one[rows] for one in free], -1)
        # What does not count is sorted behind everything that does.
        levels[~np.broadcast_to(counts[:, :, None], levels.shape)] = 256
        levels.sort(axis=-1)
        last = np.maximum(count[rows].astype(np.int64) - 1, 0)[..., None, None]
        low, middle, high = (
            np.take_along_axis(levels, np.broadcast_to(place, (*levels.shape[:3], 1)), -1)[..., 0]
            for place in (last // 4, last // 2, last - last // 4)
        )
        seen = count[rows] > 0
        color[rows][seen] = middle[seen]
        spread[rows][seen] = ((high - low).max(-1) / np.float32(_QUARTILE_SIGMAS))[seen]
    return color, spread, count


def _light_changes(
    images: list[np.ndarray], free: list[np.ndarray], color: np.ndarray, often: np.ndarray
) -> float:
    """By how many levels frames differ from the plate all over, as most of them do at worst."""
    off = []
    for image, uncovered in zip(images, free):
        both = uncovered & often
        if both.any():
            off.append(np.abs(np.median(image[both].astype(np.int16) - color[both], axis=0)).max())
    return float(np.percentile(off, _LIGHT_PERCENTILE)) if off else 0.0


def _motion_px(color: np.ndarray, spread: np.ndarray, often: np.ndarray) -> float | None:
    """How far the background wanders: what edges change over time by how steep they are."""
    steep = _steep(color)
    # The border of what is known is no edge of the room.
    known = cv2.erode(often.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    telling = known & (steep > _TEXTURE_LEVELS)
    if telling.mean() < _TEXTURE_SHARE:
        return None
    noise = float(np.percentile(spread[known], 25))
    moved = np.sqrt(np.maximum(spread[telling] ** 2 - noise**2, 0)) / steep[telling]
    return float(np.median(moved))


def _steep(color: np.ndarray) -> Float[np.ndarray, "S S"]:
    """By how many levels a colour's light changes from one pixel to the next."""
    grey = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1)
    return np.hypot(cv2.Scharr(grey, -1, 1, 0), cv2.Scharr(grey, -1, 0, 1)) / 32
