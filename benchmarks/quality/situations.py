"""A procedural person filmed within a narrow range, and the truth beyond it.

The film turns the head by 8 degrees at most, keeps mouth and brows nearly still and never smiles;
the situations are what a user then asks of the avatar.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson, as_pinhole
from rgbavatar_ns.synthetic.performer.performance import (
    MOUTH_MOODS,
    perform,
    with_tracker_noise,
)

TURNS_DEG = (15, 30, 45, 60)
_FILM_TURN_DEG = 8.0
_FILM_JAW_RAD = 0.06
_FILM_MOUTH = 0.3
_FRAMES, _HELD_OUT, _PER_SIDE = 180, 40, 4


@dataclass(frozen=True)
class Shots:
    """Frames with their truth; one camera for all."""

    theta: Float[Tensor, "F H"]
    images_rgba: UInt8[Tensor, "F S S 4"]


@dataclass(frozen=True)
class FilmedPerson:
    """One person: the film, its held-out frames, what lies beyond it, and a film of everything."""

    person: DemoPerson
    camera: PinholeCameras
    film: Shots
    everything: Shots
    """As many frames as the film's and half as many again, of the film and of what is beyond it."""
    scored: dict[str, Shots]
    """By the situation's name; "film" are the film's own held-out frames."""

    @classmethod
    def of(cls, seed: int, image_size: int, light: Literal["room", "head"]) -> "FilmedPerson":
        """Cast, act and draw; about a minute at 256 pixels."""
        config = DemoConfig(
            image_size=image_size, seed=seed, glasses=False, light=light, supersampling=2
        )
        person = DemoPerson.of(config)
        layout, names = person.head.layout, person.head.arrays.expression_names
        script = _Script(layout, names, seed)

        def shots(theta: np.ndarray) -> Shots:
            noisy = with_tracker_noise(theta, layout, names, config.theta_noise, seed)
            images = list(person.draw(torch.from_numpy(theta).float()))
            return Shots(torch.from_numpy(noisy).float(), torch.from_numpy(np.stack(images)))

        film = shots(script.film)
        beyond = shots(script.seen_beyond())
        everything = Shots(
            torch.cat([film.theta[:_FRAMES], beyond.theta]),
            torch.cat([film.images_rgba[:_FRAMES], beyond.images_rgba]),
        )
        scored = {name: shots(theta) for name, theta in script.situations().items()}
        held_out = Shots(film.theta[_FRAMES:], film.images_rgba[_FRAMES:])
        return cls(
            person,
            as_pinhole(person.camera),
            Shots(film.theta[:_FRAMES], film.images_rgba[:_FRAMES]),
            everything,
            {"film": held_out, **scored},
        )


class _Script:
    """Theta of the film and of all situations, without a tracker's noise."""

    def __init__(self, layout: ThetaLayout, expression_names: tuple[str, ...], seed: int) -> None:
        self._layout, self._names, self._seed = layout, expression_names, seed
        self._rng = np.random.default_rng([seed, 7])
        self.film = self._within(self._acted(_FRAMES + _HELD_OUT, seed))

    def _acted(self, frames: int, seed: int) -> np.ndarray:
        return perform(self._layout, self._names, frames, frames // 4, 8.0, seed)

    def _within(self, theta: np.ndarray) -> np.ndarray:
        """The performance as the film allows it."""
        theta = theta.copy()
        expression = theta[:, self._layout.slice("expression")]
        for k, name in enumerate(self._names):
            if name.startswith("brow") or "Smile" in name or "cheek" in name:
                expression[:, k] = 0
            elif not name.startswith("eye"):
                expression[:, k] *= _FILM_MOUTH
        jaw = theta[:, self._layout.slice("jaw")]
        jaw *= min(1.0, _FILM_JAW_RAD / jaw.max())
        for name in ("neck", "rotation"):
            turn = theta[:, self._layout.slice(name)]
            turn *= min(1.0, np.radians(_FILM_TURN_DEG) / 2 / np.abs(turn).max())
        return theta

    def _neutral(self, frames: int) -> np.ndarray:
        """Frames of the film, spread over it."""
        return self.film[np.linspace(0, len(self.film) - 1, frames).astype(int)].copy()

    def _turned(self, yaw_deg: np.ndarray) -> np.ndarray:
        """Film frames turned further; the neck takes what a neck can, the body the rest."""
        theta = self._neutral(len(yaw_deg))
        neck = np.clip(0.5 * yaw_deg, -30, 30)
        theta[:, self._layout.slice("neck").start + 1] = np.radians(neck)
        theta[:, self._layout.slice("rotation").start + 1] = np.radians(yaw_deg - neck)
        return theta

    def _shaped(self, frames: int, shapes: dict[str, float], level: np.ndarray) -> np.ndarray:
        """Film frames whose mouth makes these shapes; "*" stands for both sides."""
        theta = self._neutral(frames)
        start = self._layout.slice("expression").start
        for k, name in enumerate(self._names):
            if name.startswith(("mouth", "cheek", "jaw")):
                theta[:, start + k] = 0
        for name, value in shapes.items():
            if name == "jaw":
                theta[:, self._layout.slice("jaw").start] = value * level
                continue
            sides = ("Left", "Right") if name.endswith("*") else ("",)
            for side in sides:
                theta[:, start + self._names.index(name.removesuffix("*") + side)] = value * level
        return theta

    def situations(self) -> dict[str, np.ndarray]:
        """What is scored beyond the film."""
        found = {}
        for turn in TURNS_DEG:
            sides = np.repeat([-1.0, 1.0], _PER_SIDE) * turn
            found[f"turn {turn}"] = self._turned(sides)
        found["back"] = self._turned(180 + np.linspace(-40, 40, 2 * _PER_SIDE))
        found["open mouth"] = self._shaped(8, {"jaw": 0.31}, np.linspace(0.7, 1, 8))
        smiles = [self._shaped(4, dict(MOUTH_MOODS[m]), np.linspace(0.8, 1, 4)) for m in _SMILES]
        found["smile"] = np.concatenate(smiles)
        single = np.repeat(self._shaped(1, {}, np.ones(1)), len(self._names), 0)
        start = self._layout.slice("expression").start
        single[range(len(self._names)), start + np.arange(len(self._names))] = 1
        found["each expression"] = single
        found["performance"] = self._acted(24, self._seed + 500)
        return found

    def seen_beyond(self) -> np.ndarray:
        """Other frames of all situations, for the film of everything."""
        around = self._rng.uniform(-65, 65, 30), 180 + self._rng.uniform(-50, 50, 10)
        level = self._rng.uniform(0.5, 1, 8)
        single = np.repeat(self._shaped(1, {}, np.ones(1)), len(self._names), 0)
        start = self._layout.slice("expression").start
        chosen = np.arange(len(self._names))
        single[chosen, start + chosen] = self._rng.uniform(0.7, 1, len(chosen))
        smiles = [self._shaped(4, dict(MOUTH_MOODS[m]), level[:4]) for m in _SMILES]
        return np.concatenate(
            [
                *map(self._turned, around),
                self._shaped(8, {"jaw": 0.31}, level),
                *smiles,
                single,
                self._acted(30, self._seed + 900),
            ]
        )


_SMILES = ("smile", "grin")
