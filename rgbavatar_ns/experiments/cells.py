"""The cells of an experiment: one training each, known by the hash of what decides its result."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.spec import Experiment, Overrides, is_demo
from rgbavatar_ns.files import digest
from rgbavatar_ns.synthetic import DemoConfig


@dataclass(frozen=True)
class Cell:
    """One variant on one subject with one seed."""

    experiment: str
    variant: str
    preset: str
    subject: str
    seed: int
    overrides: Overrides
    cross_identity: Mapping[str, str] | None = None

    @property
    def key(self) -> str:
        """Of preset, subject, seed and overrides: cells that agree in these are one training."""
        decides: list[Any] = [self.preset, self.subject, self.seed]
        decides.append(sorted(self.overrides.items()))
        if self.cross_identity is not None:
            decides.append(sorted(self.cross_identity.items()))
        return digest([json.dumps(decides)])[:12]

    def to_json(self) -> dict[str, Any]:
        """Plain values, with the key."""
        return {**self.__dict__, "key": self.key}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Cell":
        """Build from `to_json`."""
        return cls(**{name: value for name, value in values.items() if name != "key"})


def cells_of(experiment: Experiment) -> list[Cell]:
    """All cells, in the order of the table; subjects that are folders as absolute paths.

    Raises UserError for a dataset folder or a face-recognition file that does not exist.
    """
    subjects = [_resolved(experiment, subject) for subject in experiment.subjects]
    cross_identity = _resolved_cross_identity(experiment)
    return [
        Cell(
            experiment.name,
            variant.name,
            variant.preset or experiment.preset,
            subject,
            seed,
            {**experiment.base, **variant.overrides},
            cross_identity,
        )
        for variant in experiment.variants
        for subject in subjects
        for seed in experiment.seeds
    ]


def demo_config(subject: str) -> DemoConfig | None:
    """Of "demo", "demo:SEED", "demo:SEED:FRAMES" or "demo:SEED:FRAMES:SIZE"; None for a folder.

    A quarter of the frames is held out.
    """
    if not is_demo(subject):
        return None
    numbers = subject.split(":")[1:]
    seed, frames, size = (int(n) for n in [*numbers, *("0", "240", "256")[len(numbers) :]])
    return DemoConfig(
        seed=seed, num_frames=frames, image_size=size, num_test_frames=max(1, frames // 4)
    )


def _resolved_cross_identity(experiment: Experiment) -> dict[str, str] | None:
    if experiment.cross_identity is None:
        return None
    named = dict(experiment.cross_identity)
    named["driver"] = _resolved(experiment, named["driver"])
    if "face_recognition" in named:
        path = (experiment.folder / Path(named["face_recognition"]).expanduser()).resolve()
        if not path.is_file():
            raise UserError(
                f"The experiment {experiment.name} names the face-recognition file {path}, which "
                "does not exist.",
                "Correct `face_recognition`; without it CSIM is told to be not available.",
            )
        named["face_recognition"] = str(path)
    return named


def _resolved(experiment: Experiment, subject: str) -> str:
    if demo_config(subject) is not None:
        return subject
    path = (experiment.folder / Path(subject).expanduser()).resolve()
    if not path.is_dir():
        raise UserError(
            f"The experiment {experiment.name} names the dataset {path}, which does not exist.",
            "Correct `subjects`, or use `demo` or `demo:SEED`.",
        )
    return str(path)
