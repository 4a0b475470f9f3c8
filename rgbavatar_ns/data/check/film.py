"""What a film shows of a person, what it lacks for an avatar, and what to film in its place."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.check.sample import Sample
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.head import turn_range, turn_seen

# What is asked for, and below which share of it something is called lacking: a head is tracked to
# some degrees (a person's pitch to 5), and percentiles cut off the farthest frames.
_SIDEWAYS_DEGREES, _NODDING_DEGREES = 30.0, 15.0
_NEARLY = 0.75
# Degrees of the jaw: speech opens it by 6 (two real sentences), a wide mouth by 12 to 20.
_MOUTH_OPEN_DEGREES = 10.0
# Coefficients: real speech reaches .2, smiles .6 (renders, as tracked).
_SMILE, _CLOSED = 0.35, 0.5
# Twenty seconds; a face of which a dataset's picture of 256 pixels is no enlargement.
_FRAMES, _FACE_PX = 500, 150.0
# Shares of white. A turning head changes by a tenth or two of itself in a room's light.
_DARK, _LIGHT_RATIO, _BLURRED_SHARE = 0.12, 1.4, 0.1


@dataclass(frozen=True)
class HeadTurns:
    """How far the head turns from facing the camera, in degrees (percentiles 2 and 98), at least 0.

    Left and right are the person's own.
    """

    left: float
    right: float
    up: float
    down: float

    def __str__(self) -> str:
        """A line of the report."""
        return (
            f"the head turns {self.left:.0f} degrees to its left, {self.right:.0f} to its right, "
            f"{self.up:.0f} up and {self.down:.0f} down"
        )


def head_turns(dataset: TrackedDataset) -> HeadTurns:
    """Where the face looks, as the camera sees it, whether head, neck or camera moves."""
    views = dataset.cameras.world_to_camera
    low, high = turn_range(turn_seen(dataset.theta, views, dataset.layout))
    (yaw_low, pitch_low, _), (yaw_high, pitch_high, _) = low.tolist(), high.tolist()
    # A head that turns to its left shows its right side; one that looks up is seen from below.
    return HeadTurns(*(max(0.0, turn) for turn in (-yaw_low, yaw_high, pitch_high, -pitch_low)))


@dataclass(frozen=True)
class Lack:
    """Something that a film does not show: in words, and what to do about it."""

    what: str
    advice: str


@dataclass(frozen=True)
class FilmFacts:
    """What a film shows; None where the data does not tell.

    mouth_open_degrees: of the jaw, from its usual place (percentiles 2 to 98). smile: mean
    coefficient of both sides (percentile 98). brightness: median of a frame's mean over the person,
    0 to 1; light_ratio: of the brightest to the darkest tenth of frames.
    """

    frames: int
    turns: HeadTurns
    mouth_open_degrees: float | None
    blinks: int | None
    smile: float | None
    brightness: float | None
    light_ratio: float | None
    face_height_px: float | None = None
    blurred_share: float | None = None

    def lacks(self) -> tuple[Lack, ...]:
        """What to film, most important first; nothing where all is there."""
        turns, found = self.turns, list[Lack]()
        for side, seen in (("left", turns.left), ("right", turns.right)):
            if seen < _NEARLY * _SIDEWAYS_DEGREES:
                degrees = f"({seen:.0f} of {_SIDEWAYS_DEGREES:.0f} degrees)"
                what = f"a head that turns to its {side} {degrees}"
                found.append(Lack(what, f"turn your head slowly to your {side} and back"))
        for name, verb, seen in (("up", "raise", turns.up), ("down", "lower", turns.down)):
            if seen < _NEARLY * _NODDING_DEGREES:
                what = f"a head that looks {name} ({seen:.0f} of {_NODDING_DEGREES:.0f} degrees)"
                found.append(Lack(what, f"{verb} your chin"))
        wide, smile, light = self.mouth_open_degrees, self.smile, self.light_ratio
        for missing, what, advice in (
            (_below(wide, _MOUTH_OPEN_DEGREES), "a mouth wide open", "open your mouth wide"),
            (_below(smile, _SMILE), "a smile", "smile with your teeth"),
            (_below(self.blinks, 1), "a blink", "blink and close your eyes for a moment"),
            (
                _below(self.brightness, _DARK),
                "light: the person is dark",
                "face a window or a lamp",
            ),
            (
                light is not None and light > _LIGHT_RATIO,
                "even light: it changes over the film",
                "keep still where you stand and fix the camera's exposure",
            ),
            (
                self.blurred_share is not None and self.blurred_share > _BLURRED_SHARE,
                "sharp frames",
                "move slowly, in more light",
            ),
            (
                _below(self.face_height_px, _FACE_PX),
                f"a large face ({self.face_height_px or 0:.0f} of {_FACE_PX:.0f} pixels)",
                "come nearer to the camera or film in a higher resolution",
            ),
            (
                self.frames < _FRAMES,
                f"length ({self.frames} of {_FRAMES} frames)",
                "film for a minute",
            ),
        ):
            if missing:
                found.append(Lack(what, advice))
        return tuple(found)

    def in_words(self) -> list[str]:
        """What is lacking, then one sentence of advice; nothing where nothing is."""
        lacks = self.lacks()
        if not lacks:
            return []
        advice = list(dict.fromkeys(lack.advice for lack in lacks))
        return [
            f"The film lacks {'; '.join(lack.what for lack in lacks)}.",
            f"To film it again: {', '.join(advice)} (docs/filming.md).",
        ]

    def to_json(self) -> dict[str, Any]:
        """The facts, what is lacking, and both in words."""
        lacks = [lack.what for lack in self.lacks()]
        return {**asdict(self), "lacks": lacks, "in_words": self.in_words()}


def film_facts(
    dataset: TrackedDataset,
    sample: Sample,
    face_height_px: float | None = None,
    blurred_share: float | None = None,
) -> FilmFacts:
    """What a dataset shows, its light as in some of its frames.

    Height of the face in the film (pixels) and share of blurred frames are known to who tracked it.
    """
    light = _brightness(sample)
    low, high = np.percentile(light, [10, 90])
    jaw, smile = _jaw_degrees(dataset), _coefficients(dataset, "mouthSmile")
    return FilmFacts(
        len(dataset),
        head_turns(dataset),
        None if jaw is None else float(np.diff(np.percentile(jaw, [2, 98]))[0]),
        _blinks(dataset),
        None if smile is None else float(np.percentile(smile, 98)),
        float(np.median(light)),
        float(high / max(low, 1e-6)),
        face_height_px,
        blurred_share,
    )


def _below(value: float | int | None, wanted: float | int) -> bool:
    return value is not None and value < wanted


def _coefficients(dataset: TrackedDataset, name: str) -> Float[np.ndarray, "F"] | None:
    """Mean of both sides of an expression; None where the head has none of that name."""
    names = dataset.arrays.expression_names
    both = [names.index(name + side) for side in ("Left", "Right") if name + side in names]
    if not both:
        return None
    return dataset.layout.split(dataset.theta)["expression"][:, both].mean(1).double().numpy()


def _jaw_degrees(dataset: TrackedDataset) -> Float[np.ndarray, "F"] | None:
    """The jaw's first angle; None where it never moves: then expressions open the mouth."""
    jaw = dataset.layout.split(dataset.theta).get("jaw")
    if jaw is None or not (jaw != jaw[:1]).any():
        return None
    return np.degrees(jaw[:, 0].double().numpy())


def _blinks(dataset: TrackedDataset) -> int | None:
    """How often both eyes close; None where the head's lids have no number."""
    closed = _coefficients(dataset, "eyeBlink")
    lids = dataset.layout.split(dataset.theta).get("eyelids")
    if lids is not None and lids.shape[1]:
        closed = lids.mean(1).double().numpy()
    if closed is None:
        return None
    shut = closed > _CLOSED
    return int(shut[0]) + int(np.count_nonzero(shut[1:] & ~shut[:-1]))


def _brightness(sample: Sample) -> Float[np.ndarray, "n"]:
    """Mean over the person in each frame of a sample, 0 to 1."""
    person = sample.alpha * sample.filmed
    shone = (sample.gray * sample.filmed).sum((1, 2))
    return shone / np.maximum(person.sum((1, 2)), 1e-6)
