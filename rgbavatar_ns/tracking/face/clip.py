"""The landmarks of the followed face over a whole clip, and which frames have none."""

from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import FRAME_RATES
from rgbavatar_ns.reading import DamagedFileError, load_arrays
from rgbavatar_ns.tracking.face.detector import face_height_px
from rgbavatar_ns.tracking.face.follow import FaceFollower
from rgbavatar_ns.tracking.face.iris import FoundIrises
from rgbavatar_ns.tracking.resumable_run import stage_damage_told

# In one frame's time a face moves and grows by less than this; more is a cut or a jump.
_JUMP_SHARE, _JUMP_SIZE = 0.4, 1.3
# And by landmarks that move by this share of its height, in the root of their mean square, if they
# move more than so many times as far as in any of so many steps before and after. Where films of
# heads are cut and drawn nearer by 1.3 it is .15 and 6 times; of heads that move, and cameras in a
# hand, up to .05 and 3 times.
_CUT_SHARE, _CUT_TIMES, _CUT_AROUND = 0.06, 3.0, 3
# A pause between two frames' times beyond this many usual ones of their clip is a gap, if it is as
# long as this: where a film is now slow motion and now not, either's steps are usual.
_PAUSE, _LEAST_PAUSE_S = 4.0, 0.1
# Sharpness below this share of the clip's sharp frames' (its 90th percentile: most frames may be
# blurred) is noted as blur. Frames of a face that talks and keeps still are above .7.
_BLURRED, _SHARP_PERCENT = 0.35, 90
# A film whose frames come unevenly is told from here on: so far off sound and lips are felt apart.
# A telephone's jitter shifts frames by some milliseconds, a single frame that it leaves out by 33.
_SHIFTED_S = 0.1
# Rates that differ by less are one: times of single frames are rounded.
_SAME_RATE = 0.03
_MOST_BYTES = 1 << 32
_PER_FRAME, _POINTS, _IRISES = ("count", "clip", "time_s", "has_alpha"), (478, 2), (2, 2)


@dataclass(frozen=True)
class SeenFaces:
    """Every face in every frame read: `count` faces of frame f lie in a row in `points`.

    `points` and `irises` are shares of the frame's width and height; `iris_sigma` are the irises'
    standard errors as `FoundIrises` has them; `sharpness` has any unit; `time_s` is NaN where the
    source has no clock; `has_alpha` tells frames whose alpha may be a matte.
    """

    count: Int[np.ndarray, "F"]
    clip: Int[np.ndarray, "F"]
    time_s: Float[np.ndarray, "F"]
    has_alpha: Bool[np.ndarray, "F"]
    points: Float[np.ndarray, "N 478 2"]
    irises: Float[np.ndarray, "N 2 2"]
    iris_sigma: Float[np.ndarray, "N 2 2"]
    sharpness: Float[np.ndarray, "N"]

    def __len__(self) -> int:
        return len(self.count)

    @classmethod
    def joined(cls, parts: "Collection[SeenFaces]") -> "SeenFaces":
        """One after the other."""
        names = [item.name for item in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    @classmethod
    def load(cls, path: Path) -> "SeenFaces":
        """What `np.savez(path, **vars(faces))` wrote; UserError where it holds anything else."""
        with stage_damage_told(path, "faces that were found"):
            arrays = load_arrays(path, _MOST_BYTES)
            faces = cls(*(arrays[item.name] for item in fields(cls)))
            rows = [getattr(faces, name).shape for name in _PER_FRAME]
            shown = [(len(faces.sharpness), *size) for size in (_POINTS, _IRISES, _IRISES)]
            there = [one.shape for one in (faces.points, faces.irises, faces.iris_sigma)]
            whole = faces.count.dtype.kind == "i" and (faces.count >= 0).all()
            if rows != [(len(faces),)] * len(rows) or there != shown or not whole:
                raise DamagedFileError("its arrays do not fit together")
            if faces.count.sum() != len(faces.points):
                raise DamagedFileError("it counts other faces than it holds")
            return faces


@dataclass(frozen=True)
class ClipLandmarks:
    """Landmarks and irises (source pixels) of the frames that show the followed face, and which.

    `frame_index` counts all frames read, `clip` says from which file each one is, `segment` counts
    up at each gap, cut or jump. `with_others` lists frames in which another face was seen too,
    `blurred` those whose face is far less sharp than usual. `frames_per_second` is None where the
    source has no clock.
    """

    points_px: Float[np.ndarray, "F 478 2"]
    irises: FoundIrises
    frame_index: tuple[int, ...]
    clip: tuple[int, ...]
    segment: tuple[int, ...]
    frames_read: int
    width: int
    height: int
    with_others: tuple[int, ...]
    blurred: tuple[int, ...]
    frames_per_second: float | None = None

    def __len__(self) -> int:
        return len(self.frame_index)

    def follows(self) -> list[bool]:
        """Whether each frame comes directly after the one before it, without gap, cut or jump."""
        steps = zip(self.frame_index, self.frame_index[1:], self.segment, self.segment[1:])
        return [False] + [b == a + 1 and c == d for a, b, c, d in steps]

    def without(self, positions: Collection[int]) -> "ClipLandmarks":
        """The same without the frames at these positions."""
        left_out = frozenset(positions)
        keep = [k for k in range(len(self)) if k not in left_out]
        return replace(
            self,
            points_px=self.points_px[keep],
            irises=self.irises.of(keep),
            frame_index=tuple(self.frame_index[k] for k in keep),
            clip=tuple(self.clip[k] for k in keep),
            segment=tuple(self.segment[k] for k in keep),
        )

    def segments(self) -> list[dict[str, Any]]:
        """First and last frame of each stretch that is tracked without a break."""
        starts = [k for k, goes_on in enumerate(self.follows()) if not goes_on]
        ends = [*(k - 1 for k in starts[1:]), len(self) - 1]
        return [
            {
                "first_frame": self.frame_index[a],
                "last_frame": self.frame_index[b],
                "clip": self.clip[a],
            }
            for a, b in zip(starts, ends)
        ]


def followed_face(seen: SeenFaces, width: int, height: int) -> ClipLandmarks:
    """Keep to one face of those that were seen; UserError if there is none in any frame."""
    size = (width, height)
    first_face = np.concatenate([[0], np.cumsum(seen.count)])
    positions, others, jumps = _positions(seen, first_face, size)
    if not positions:
        raise UserError(
            f"No face was found in any of the {len(seen)} frames.",
            "Use a video in which a face is seen from the front, in good light, and at least "
            "60 pixels high.",
        )
    index = list(positions)
    rows = first_face[index] + list(positions.values())
    landmarks = seen.points[rows]
    landmarks *= size
    return ClipLandmarks(
        landmarks,
        FoundIrises(seen.irises[rows] * size, seen.iris_sigma[rows]),
        tuple(index),
        tuple(int(seen.clip[k]) for k in index),
        _segments(landmarks, np.array(index), seen, jumps),
        len(seen),
        width,
        height,
        tuple(frame for frame, count in others.items() if count > 0),
        _blurred(seen.sharpness[rows], index),
        _frames_per_second(seen),
    )


def _positions(
    seen: SeenFaces, first_face: Int[np.ndarray, "G"], size: tuple[int, int]
) -> tuple[dict[int, int], dict[int, int], list[int]]:
    """In which frames the followed face is seen and which of theirs it is, how many others there
    are in each, and in which frames it has jumped, as where a film was cut."""
    positions: dict[int, int] = {}
    others: dict[int, int] = {}
    jumps: list[int] = []
    follower, first = FaceFollower(), 0
    for frame in range(len(seen)):
        if frame > 0 and seen.clip[frame] != seen.clip[frame - 1]:
            follower, first = FaceFollower(), frame  # Where faces were tells nothing here.
        faces = seen.points[int(first_face[frame]) : int(first_face[frame + 1])] * size
        sighting = follower(faces, *size)
        others[frame] = sighting.others
        if sighting.position is None:
            continue
        for earlier, position in sighting.before:
            positions[first + earlier] = position
            others[first + earlier] -= 1
        positions[frame] = sighting.position
        if sighting.jumped:
            jumps.append(first + sighting.before[0][0] if sighting.before else frame)
    return positions, others, jumps


def rate_notes(seen: SeenFaces) -> list[str]:
    """What to tell of a film that will play otherwise than it was filmed."""
    kept, rates = _frames_per_second(seen), _clip_rates(seen)
    if kept is None:
        return []
    notes = [note for clip in rates for note in _uneven_notes(seen, clip, len(rates) > 1)]
    if any(abs(rate / kept - 1) > _SAME_RATE for rate in rates.values()):
        told = ", ".join(f"{rate:.4g}" for rate in rates.values())
        all_play = f"all play at {kept:.4g}, the longest one's"
        notes.append(f"the clips have {told} frames a second; {all_play}")
    return notes


def _uneven_notes(seen: SeenFaces, clip: int, of_several: bool) -> list[str]:
    """How far a clip's frames lie from where they are played, evenly and without its pauses."""
    steps = _usual_steps_s(seen, clip)
    shifted_s = float(np.abs(np.cumsum(steps - steps.mean())).max())
    slow, usual, fast = 1 / np.percentile(steps, (95, 50, 5))
    # A few frames that are left out shift a slow film as far, and change no rate.
    if shifted_s <= _SHIFTED_S or fast / slow - 1 <= _SAME_RATE:
        return []
    whose = f"clip {clip + 1}'s" if of_several else "the film's"
    return [
        f"{whose} frames come at a varying rate, {slow:.3g} to {fast:.3g} a second, and play "
        f"evenly: up to {shifted_s:.1f} s too early or too late. A film of one rate, to be tracked "
        f"in its place: ffmpeg -i FILM -vf fps={usual:.5g} EVEN.mp4"
    ]


def _frames_per_second(seen: SeenFaces) -> float | None:
    """The film's rate: that of the clip of most frames, since a mean would be none's.

    None without a clock, or beyond what a dataset takes.
    """
    rates = _clip_rates(seen)
    if not rates:
        return None
    rate = rates[max(rates, key=lambda clip: np.count_nonzero(seen.clip == clip))]
    return round(rate, 3) if FRAME_RATES.holds(rate) else None


def _clip_rates(seen: SeenFaces) -> dict[int, float]:
    """Each clip's frames a second, over the steps between its frames that are no pauses.

    By their mean, since many files round times to milliseconds; clips without a clock have none.
    """
    steps = {int(clip): _usual_steps_s(seen, int(clip)) for clip in np.unique(seen.clip)}
    return {clip: 1 / float(times.mean()) for clip, times in steps.items() if len(times)}


def _usual_steps_s(seen: SeenFaces, clip: int) -> Float[np.ndarray, "G"]:
    """Between a clip's frames, where time goes on and that is no pause."""
    rows = seen.clip == clip
    steps, most = np.diff(seen.time_s[rows]), _longest_step_s(seen)[rows][1:]
    return steps[(steps > 0) & (steps <= most)]


def _longest_step_s(seen: SeenFaces) -> Float[np.ndarray, "F"]:
    """Up to how long after the one before it each frame still follows that; NaN without a clock."""
    longest = np.full(len(seen), np.nan)
    for clip in np.unique(seen.clip):
        rows = seen.clip == clip
        steps = np.diff(seen.time_s[rows])
        steps = steps[steps > 0]
        if len(steps):
            longest[rows] = max(_PAUSE * float(np.median(steps)), _LEAST_PAUSE_S)
    return longest


def _segments(
    points_px: Float[np.ndarray, "F 478 2"],
    index: Int[np.ndarray, "F"],
    seen: SeenFaces,
    jumps: list[int],
) -> tuple[int, ...]:
    height = face_height_px(points_px) + 1e-9
    center = points_px.mean(1)
    moved = np.linalg.norm(np.diff(center, axis=0), axis=1) / height[1:]
    grown = np.maximum(height[1:], height[:-1]) / np.minimum(height[1:], height[:-1])
    breaks = (moved > _JUMP_SHARE) | (grown > _JUMP_SIZE) | (np.diff(index) > 1)
    breaks |= _sudden(points_px, height)
    breaks |= np.diff(seen.clip[index]) != 0
    breaks |= np.isin(index[1:], jumps)
    breaks |= np.diff(seen.time_s[index]) > _longest_step_s(seen)[index[1:]]
    return tuple(int(number) for number in np.concatenate([[0], np.cumsum(breaks)]))


def _sudden(
    points_px: Float[np.ndarray, "F 478 2"], height_px: Float[np.ndarray, "F"]
) -> Bool[np.ndarray, "G"]:
    """Where a film of one person was cut: steps far longer than those before and after them.

    A head that starts or stops takes some frames for it. Of a film that shows each frame twice or
    three times every other step is none.
    """
    # Frame by frame: of a long film one more array of all landmarks is much memory.
    moved_px = (np.linalg.norm(then - now, axis=1) for now, then in pairwise(points_px))
    step = np.sqrt([np.square(one).mean() for one in moved_px]) / height_px[1:]
    around = np.pad(step, _CUT_AROUND)
    beside = [k for k in range(2 * _CUT_AROUND + 1) if k != _CUT_AROUND]
    usual = np.max([around[k : k + len(step)] for k in beside], axis=0)
    return (step > _CUT_SHARE) & (step > _CUT_TIMES * usual)


def _blurred(sharpness: Float[np.ndarray, "F"], index: list[int]) -> tuple[int, ...]:
    poor = sharpness < _BLURRED * np.percentile(sharpness, _SHARP_PERCENT)
    return tuple(index[k] for k in np.flatnonzero(poor))
