"""The cells of an experiment: one training each, known by the hash of what decides its result."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rgbavatar_ns.data.demo import DemoConfig
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.spec import Experiment, Overrides

_DEMO = "demo"


@dataclass(frozen=True)
class Cell:
    """One variant on one subject with one seed."""

    experiment: str
    variant: str
    preset: str
    subject: str
    seed: int
    overrides: Overrides

    @property
    def key(self) -> str:
        """Of preset, subject, seed and overrides: cells that agree in these are one training."""
        decides = [self.preset, self.subject, self.seed, sorted(self.overrides.items())]
        return hashlib.sha256(json.dumps(decides).encode()).hexdigest()[:12]

    def to_json(self) -> dict[str, Any]:
        """Plain values, with the key."""
        return {**self.__dict__, "key": self.key}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> "Cell":
        """Build from `to_json`."""
        return cls(**{name: value for name, value in values.items() if name != "key"})


def cells_of(experiment: Experiment) -> list[Cell]:
    """All cells, in the order of the table; subjects that are folders as absolute paths.

    Raises UserError for a dataset folder that does not exist.
    """
    subjects = [_resolved(experiment, subject) for subject in experiment.subjects]
    return [
        Cell(
            experiment.name,
            variant.name,
            experiment.preset,
            subject,
            seed,
            {**experiment.base, **variant.overrides},
        )
        for variant in experiment.variants
        for subject in subjects
        for seed in experiment.seeds
    ]


def demo_config(subject: str) -> DemoConfig | None:
    """Of "demo", "demo:SEED", "demo:SEED:FRAMES" or "demo:SEED:FRAMES:SIZE"; None for a folder.

    A quarter of the frames is held out.
    """
    kind, *numbers = subject.split(":")
    if kind != _DEMO or len(numbers) > 3 or not all(number.isdigit() for number in numbers):
        return None
    seed, frames, size = (int(n) for n in [*numbers, *("0", "240", "256")[len(numbers) :]])
    return DemoConfig(
        seed=seed, num_frames=frames, image_size=size, num_test_frames=max(1, frames // 4)
    )


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
