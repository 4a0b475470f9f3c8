"""How good a run was after how many seconds of training, beside training.json."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rgbavatar_ns.files import read_json, write_json

CURVE_NAME = "curve.json"


class EvaluationCurve:
    """Held-out scores as training goes on, one point an evaluation of all held-out frames.

    `points` is what a checkpoint keeps, so that a resumed run goes on with them.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / CURVE_NAME
        self.points: list[dict[str, int | float]] = []

    def add(self, step: int, train_seconds: float, scores: Mapping[str, Any]) -> None:
        """Write a point: the scores after `step`, which is counted from 0."""
        finite = {
            name: float(value)
            for name, value in scores.items()
            if isinstance(value, int | float) and math.isfinite(value)
        }
        self.points.append({"step": step, "train_seconds": train_seconds, **finite})
        write_json(self._path, {"points": self.points})


def read_curve(path: Path) -> list[dict[str, int | float]]:
    """The points in order; none where there is no such file."""
    content = read_json(path)
    return [] if content is None else content["points"]
