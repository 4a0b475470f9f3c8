"""What the person does: speech, moods, blinks, glances and head turns, as theta of each frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.head.arrays import NECK_SHIFTS

Body = Literal["none", "sway", "still", "lean"]
"""What the torso does; without one the head sways as if there were."""
Shapes = Mapping[str, float]
"""Expression coefficients by name; "Left" and "Right" are added to a name that ends in "*", and
"jaw" is the jaw's opening in radians."""

MOUTH_MOODS: dict[str, Shapes] = {
    "smile": {"mouthSmile*": 0.80, "cheekSquint*": 0.45, "eyeSquint*": 0.30, "mouthDimple*": 0.2},
    "grin": {"mouthSmile*": 0.80, "cheekSquint*": 0.6, "mouthUpperUp*": 0.65, "jaw": 0.08,
             "mouthLowerDown*": 0.4, "eyeSquint*": 0.4},
    "sad": {"mouthFrown*": 0.85, "mouthShrugLower": 0.6, "mouthStretch*": 0.2},
    "gape": {"jaw": 0.30, "mouthFunnel": 0.25},
    "sneer": {"noseSneer*": 0.95, "mouthUpperUp*": 0.5, "cheekSquint*": 0.2},
    "puff": {"cheekPuff": 0.85, "mouthPress*": 0.3},
}  # fmt: skip
BROW_MOODS: dict[str, Shapes] = {
    "raise": {"browInnerUp": 0.85, "browOuterUp*": 0.8, "eyeWide*": 0.35},
    "frown": {"browDown*": 0.95, "eyeSquint*": 0.35},
    "worry": {"browInnerUp": 0.95, "browDown*": 0.25},
    "calm": {},
}
VISEMES: dict[str, Shapes] = {
    "aa": {"jaw": 0.24, "mouthLowerDown*": 0.25, "mouthUpperUp*": 0.15},
    "ee": {"jaw": 0.08, "mouthStretch*": 0.45, "mouthSmile*": 0.12, "mouthLowerDown*": 0.3},
    "oo": {"jaw": 0.07, "mouthPucker": 0.65, "mouthFunnel": 0.35},
    "oh": {"jaw": 0.17, "mouthFunnel": 0.55, "mouthPucker": 0.25},
    "mm": {"mouthPress*": 0.35, "mouthRollLower": 0.25, "mouthRollUpper": 0.2},
    "ff": {"jaw": 0.03, "mouthRollLower": 0.45, "mouthUpperUp*": 0.25},
    "ss": {"jaw": 0.03, "mouthStretch*": 0.25, "mouthLowerDown*": 0.35, "mouthUpperUp*": 0.2},
}
EARLY_ONLY = ("sneer", "puff")
"""Moods of the first third of training, not seen again before the held-out frames."""


def perform(
    layout: ThetaLayout,
    expression_names: Sequence[str],
    num_frames: int,
    num_test_frames: int,
    frames_per_second: float,
    seed: int,
    body: Body = "none",
) -> Float[np.ndarray, "F H"]:
    """Script a performance whose held-out end combines what training showed apart.

    Early in training the head looks to its left, and there are moods that only come back in the
    held-out frames; then it looks to its right; held out, all of it is mixed. An avatar that
    forgets the beginning of the stream fails at the end.
    """
    rng = np.random.default_rng([seed, 1])
    seconds = np.arange(num_frames) / frames_per_second
    train_end = (num_frames - num_test_frames) / frames_per_second
    early_end = train_end / 3
    names = list(expression_names)
    expression = _Expression(names, seconds)
    talk = _talking(rng, seconds)
    common = [name for name in MOUTH_MOODS if name not in EARLY_ONLY]
    # Every mood is to come back however short the end is.
    hurried = float(np.clip((seconds[-1] - train_end) / (1.1 * len(MOUTH_MOODS)), 0.3, 1.3))
    moods = (
        _Deck(early_end, [*EARLY_ONLY, *common[:2]], 1.2),
        _Deck(train_end, common, 1.25),
        _Deck(np.inf, [*MOUTH_MOODS], hurried),
    )
    for start, length, name in _dealt(rng, seconds[-1], moods):
        level = rng.uniform(0.7, 1.0)
        expression.add(MOUTH_MOODS[name], level * _hump(seconds, start, length, 0.35))
    for start, length, name in _dealt(rng, seconds[-1], [_Deck(np.inf, [*BROW_MOODS], 1.05)]):
        level = rng.uniform(0.65, 1.0)
        expression.add(BROW_MOODS[name], level * _hump(seconds, start, length, 0.3))
    for start, length, name in _dealt(rng, seconds[-1], [_Deck(np.inf, [*VISEMES], 0.24)]):
        level = talk * rng.uniform(0.6, 1.0)
        expression.add(VISEMES[name], level * _hump(seconds, start, 1.7 * length, 0.12))
    gaze = _gaze(rng, seconds)
    _lids(rng, seconds, gaze, expression)
    head = _head_turns(rng, seconds, early_end, train_end)
    if body in ("still", "lean"):
        head |= _torso_motion(seconds, seed, body)
    theta = _join(layout, expression, gaze, head)
    if body != "none":
        theta[:, _neck_columns(layout, names)] = _neck_shifts_cm(seconds, seed)
    return theta


def _neck_columns(layout: ThetaLayout, names: Sequence[str]) -> list[int]:
    """Where theta has a bust's neck shifts; none for a head alone."""
    first = layout.slice("expression").start
    return [first + names.index(name) for name in NECK_SHIFTS if name in names]


def with_tracker_noise(
    theta: Float[np.ndarray, "F H"],
    layout: ThetaLayout,
    expression_names: Sequence[str],
    strength: float,
    seed: int,
) -> Float[np.ndarray, "F H"]:
    """Theta as a tracker finds it: half of the error flickers, half drifts over some frames.

    A coefficient of an expression is not found below zero; a bust's neck shifts are, in both ways.
    """
    rng = np.random.default_rng([seed, 2])
    scale = np.concatenate(
        [
            np.full(
                field.size, {"linear": 0.010, "axis_angle": 0.0018, "translation": 1e-4}[field.form]
            )
            for field in layout.fields
        ]
    )
    drift = rng.standard_normal(theta.shape)
    for frame in range(1, len(drift)):
        drift[frame] = 0.9 * drift[frame - 1] + np.sqrt(1 - 0.9**2) * drift[frame]
    error = np.sqrt(0.5) * (rng.standard_normal(theta.shape) + drift)
    noisy = theta + strength * scale * error
    if strength > 0:
        shifts = _neck_columns(layout, expression_names)
        columns = np.setdiff1d(np.arange(layout.size)[layout.slice("expression")], shifts)
        noisy[:, columns] = np.maximum(noisy[:, columns], 0)
    return noisy


class _Expression:
    """Expression coefficients and the jaw over time, summed up from shapes."""

    def __init__(self, names: Sequence[str], seconds: np.ndarray) -> None:
        self._column = {name: k for k, name in enumerate(names)}
        self.coefficients = np.zeros((len(seconds), len(names)))
        self.jaw = np.zeros(len(seconds))

    def add(self, shapes: Shapes, level: np.ndarray) -> None:
        """Add shapes, each times `level` over time."""
        for name, value in shapes.items():
            if name == "jaw":
                self.jaw += value * level
                continue
            sides = ("Left", "Right") if name.endswith("*") else ("",)
            for side in sides:
                self.coefficients[:, self._column[name.removesuffix("*") + side]] += value * level


def _hump(seconds: np.ndarray, start: float, length: float, ramp: float) -> np.ndarray:
    """From 0 to 1 within `ramp` seconds and back at the end of `length`, smoothly."""
    ramp = min(ramp, length / 2)
    up = np.clip((seconds - start) / ramp, 0, 1)
    down = np.clip((start + length - seconds) / ramp, 0, 1)
    rise = np.minimum(up, down)
    return rise * rise * (3 - 2 * rise)


@dataclass(frozen=True)
class _Deck:
    """Cards in force until a time; each lasts some `length` seconds."""

    until: float
    cards: list[str]
    length: float


def _dealt(
    rng: np.random.Generator, end: float, decks: Sequence[_Deck]
) -> list[tuple[float, float, str]]:
    """Deal (start, length, card) one after another until `end`: cards of the deck in force,
    without repeats until it is used up and shuffled again."""
    now = 0.1 * decks[0].length
    dealt, hand, in_force = [], [], None
    while now < end:
        deck = next(deck for deck in decks if now < deck.until)
        if deck is not in_force or not hand:
            in_force, hand = deck, list(rng.permutation(deck.cards))
        length = deck.length * rng.uniform(0.75, 1.3)
        dealt.append((now, length, str(hand.pop())))
        now += length
    return dealt


def _talking(rng: np.random.Generator, seconds: np.ndarray) -> np.ndarray:
    """How much the person speaks: sentences of two to three seconds with pauses."""
    level, now = np.zeros(len(seconds)), rng.uniform(0, 0.8)
    while now < seconds[-1]:
        length = rng.uniform(1.8, 3.2)
        level += _hump(seconds, now, length, 0.2)
        now += length + rng.uniform(0.6, 1.6)
    return level


def _gaze(rng: np.random.Generator, seconds: np.ndarray) -> np.ndarray:
    """Pitch and yaw of both eyes [F, 2] in radians: glances with quick changes between."""
    gaze, now, place = np.zeros((len(seconds), 2)), 0.0, np.zeros(2)
    while now <= seconds[-1]:
        target = rng.uniform([-0.10, -0.26], [0.14, 0.26]) * rng.choice([1.0, 1.0, 0.3])
        blend = np.clip((seconds - now) / 0.12, 0, 1)[:, None]
        gaze = np.where(seconds[:, None] >= now, place + (target - place) * blend, gaze)
        place, now = target, now + rng.uniform(0.6, 1.5)
    return gaze


def _lids(
    rng: np.random.Generator, seconds: np.ndarray, gaze: np.ndarray, expression: _Expression
) -> None:
    """Blinks, and lids that follow the eyes up and down."""
    closed, now = np.zeros(len(seconds)), rng.uniform(0.5, 1.5)
    while now < seconds[-1]:
        closed = np.maximum(closed, _hump(seconds, now, 0.34, 0.13))
        now += rng.uniform(1.3, 3.0)
    lowered = np.maximum(closed, np.clip(1.6 * gaze[:, 0], 0, 0.3))
    expression.add({"eyeBlink*": 1.0}, lowered)
    expression.add({"eyeWide*": 1.0}, np.clip(-2.0 * gaze[:, 0], 0, 0.3) * (1 - closed))


def _waves(rng: np.random.Generator, seconds: np.ndarray, periods: tuple[float, ...]) -> np.ndarray:
    """A smooth wandering in [-1, 1]."""
    total = np.zeros(len(seconds))
    for period in periods:
        total += np.sin(2 * np.pi * (seconds / period + rng.uniform()))
    return total / len(periods)


def _head_turns(
    rng: np.random.Generator, seconds: np.ndarray, early_end: float, train_end: float
) -> dict[str, np.ndarray]:
    """Neck and whole-body rotation [F, 3] (axis-angle) and translation [F, 3]."""
    degree = np.pi / 180
    times = [0.0, early_end, early_end + 1.0, train_end, train_end + 0.5]
    middle = np.interp(seconds, times, [12.0, 12.0, -9.0, -9.0, 0.0])
    reach = np.interp(seconds, times, [13.0, 13.0, 16.0, 16.0, 21.0])
    yaw = (middle + reach * np.sin(1.35 * _waves(rng, seconds, (2.7, 4.6)))) * degree
    nod = _waves(rng, seconds, (1.3, 0.9)) * np.clip(_waves(rng, seconds, (4.0, 7.0)), 0, 1)
    pitch = (9.0 * _waves(rng, seconds, (3.1, 5.2)) + 5.0 * nod) * degree
    roll = 7.0 * degree * _waves(rng, seconds, (3.6, 6.4))
    sway = [3.0 * degree * _waves(rng, seconds, (6.7, 9.1)) for _ in range(3)]
    drift = [size * _waves(rng, seconds, (5.9, 8.3)) for size in (0.004, 0.003, 0.006)]
    return {
        "neck": np.stack([pitch, yaw, roll], 1),
        "rotation": np.stack(sway, 1) * [0.6, 1.0, 0.5],
        "translation": np.stack(drift, 1),
    }


def _torso_motion(seconds: np.ndarray, seed: int, body: Body) -> dict[str, np.ndarray]:
    """Rotation and translation of a torso that keeps still, or leans to all sides."""
    if body == "still":
        return {name: np.zeros((len(seconds), 3)) for name in ("rotation", "translation")}
    rng = np.random.default_rng([seed, 3])
    lean = [_waves(rng, seconds, (3.7, 5.3)) * np.radians(degrees) for degrees in (9.0, 7.0, 8.0)]
    drift = [_waves(rng, seconds, (4.1, 6.1)) * size for size in (0.025, 0.01, 0.03)]
    return {"rotation": np.stack(lean, 1), "translation": np.stack(drift, 1)}


def _neck_shifts_cm(seconds: np.ndarray, seed: int) -> np.ndarray:
    """How the neck carries the head beside its turns [F, 3]: no neck has one joint."""
    rng = np.random.default_rng([seed, 4])
    return np.stack([size * _waves(rng, seconds, (2.9, 4.3)) for size in (0.4, 0.2, 0.6)], 1)


def _join(
    layout: ThetaLayout, expression: _Expression, gaze: np.ndarray, head: dict[str, np.ndarray]
) -> np.ndarray:
    theta = np.zeros((len(gaze), layout.size))
    theta[:, layout.slice("expression")] = expression.coefficients.clip(0, 1)
    theta[:, layout.slice("jaw").start] = expression.jaw.clip(0, 0.36)
    for side, vergence in (("left_eye", -0.02), ("right_eye", 0.02)):
        start = layout.slice(side).start
        theta[:, start] = gaze[:, 0]
        theta[:, start + 1] = gaze[:, 1] + vergence
    for name, values in head.items():
        theta[:, layout.slice(name)] = values
    return theta
