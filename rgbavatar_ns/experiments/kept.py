"""Results as the documentation's JSON keeps them, by cell: what was finished elsewhere counts."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.cells import Cell
from rgbavatar_ns.experiments.spec import subject_name
from rgbavatar_ns.files import read_json

Curve = Mapping[int, tuple[float, float]]
"""Seconds of training and held-out PSNR, by step."""
_RESULT = ("metrics", "made", "unavailable")


def portable_keys(cells: Sequence[Cell]) -> dict[str, str]:
    """By each cell's key the one that it has on every machine, where files count by their names.

    Datasets that share a name are told apart by their paths, and cells of them are this machine's.
    """
    places = {cell.subject for cell in cells}
    names = Counter(subject_name(place) for place in places)
    keys: dict[str, str] = {}
    for cell in cells:
        crossed = cell.cross_identity
        if crossed is not None:
            crossed = {name: subject_name(value) for name, value in crossed.items()}
        name = subject_name(cell.subject)
        subject = name if names[name] == 1 else cell.subject
        keys[cell.key] = replace(cell, subject=subject, cross_identity=crossed).key
    return keys


def kept_form(cell: Cell, result: Mapping[str, Any], curve: Curve) -> dict[str, Any]:
    """What is kept of a finished cell: its result without this machine's places, and its curve."""
    told = {"variant": cell.variant, "subject": subject_name(cell.subject), "seed": cell.seed}
    kept = {name: result[name] for name in _RESULT if name in result}
    return {**told, **kept, "curve": {str(step): list(point) for step, point in curve.items()}}


def kept_results(path: Path) -> dict[str, dict[str, Any]]:
    """The results in a file of `rgbavatar report --into`, by the cells' portable keys.

    Each as `runner.read_result` gives it, with a "curve" in it. Raises UserError where the file
    holds none.
    """
    content = read_json(path)
    try:
        return {key: _result(kept) for key, kept in content["cells"].items()}
    except (TypeError, ValueError, KeyError, AttributeError):
        raise UserError(
            f"{path} holds no results of cells.",
            "Name a file DOCS/results/NAME.json that `rgbavatar report FOLDER --into DOCS` wrote; "
            "delete one of an earlier version.",
        ) from None


def _result(kept: Mapping[str, Any]) -> dict[str, Any]:
    result = {name: kept[name] for name in _RESULT if name in kept}
    # JSON has no NaN: a figure that is not finite was kept as null.
    result["metrics"] = {
        name: math.nan if value is None else float(value) for name, value in kept["metrics"].items()
    }
    return {**result, "curve": dict(kept["curve"])}


def kept_curve(result: Mapping[str, Any]) -> dict[int, tuple[float, float]] | None:
    """The curve in a result that was kept; None in one of a cell that ran here."""
    curve = result.get("curve")
    if curve is None:
        return None
    points = {int(step): point for step, point in curve.items()}
    return {step: (seconds, math.nan if p is None else p) for step, (seconds, p) in points.items()}
