"""An experiment as a YAML file: a preset, what is varied, over which subjects and seeds."""

import difflib
import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from rgbavatar_ns.errors import UserError

METRICS = {
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 4),
    "lpips_vgg": ("LPIPS (VGG)", 4),
    "l1_streamed": ("L1, streamed frames", 4),
    "e_orth": ("e_orth", 4),
    "images_per_second": ("images/s", 1),
    "train_seconds": ("training, s", 0),
    "aed": ("AED", 4),
    "apd": ("APD", 4),
    "csim": ("CSIM", 4),
}
"""Heading and digits of what a table may show; the first three are of the held-out frames,
`l1_streamed` is of the frames that a stream brought, after its end; the last three need
`cross_identity`."""

_CROSS_IDENTITY = ("driver", "tracker", "face_recognition")

Overrides = dict[str, Any]
"""Dotted fields of a preset's config, as on ns-train's command line, with their values."""


@dataclass(frozen=True)
class Variant:
    """One row of the table: what it changes, and what the paper published for it.

    Rows that a grid made of one listed variant share its `family`, a line of a plot.
    """

    name: str
    overrides: Overrides = field(default_factory=dict)
    paper: Mapping[str, float] = field(default_factory=dict)
    family: str = ""


@dataclass(frozen=True)
class Experiment:
    """One table or figure: variants x subjects x seeds of one preset.

    A subject is "demo" or "demo:SEED" (the procedural one, 240 frames), or a dataset's folder,
    relative to the YAML file. `plot` names the override that a figure has on its x axis.
    """

    name: str
    title: str
    preset: str
    variants: tuple[Variant, ...]
    subjects: tuple[str, ...] = ("demo",)
    seeds: tuple[int, ...] = (0,)
    base: Overrides = field(default_factory=dict)
    metrics: tuple[str, ...] = ("psnr", "ssim", "lpips_vgg")
    plot: str | None = None
    paper_data: str | None = None
    """The data set that the paper's figures are of: they stand beside ours, not against them,
    unless it is the one named here."""
    cross_identity: Mapping[str, str] | None = None
    """A `driver` (a subject) whose held-out frames drive every avatar, a `tracker`
    (module:function) for AED and APD, and a `face_recognition` ONNX file for CSIM."""
    folder: Path = Path()

    def __post_init__(self) -> None:
        for what in ("variants", "subjects", "seeds"):
            if not getattr(self, what):
                raise _refusal(self.name, f"has no {what}", f"List at least one under `{what}`.")
        names = [variant.name for variant in self.variants]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            cause = f"has two variants named {twice[0]!r}"
            raise _refusal(self.name, cause, "Give each its own name.")


def read_experiment(path: Path, *, tiny: bool = False) -> Experiment:
    """Read and check a YAML file; `tiny` applies its section of that name.

    Keys: name, title, preset, variants (name, set, paper), grid (override -> values; each
    combination is a variant), subjects, seeds, base, metrics, plot, paper_data, tiny (any of
    these anew). Raises UserError naming the key for anything unknown, missing or of a wrong type.
    Whether overrides fit the preset is checked by `overrides.check_overrides`.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        cause = f"{path} cannot be read: {error}."
        raise UserError(cause, "Check the path and its YAML.") from None
    if not isinstance(content, dict):
        raise _refusal(path.name, "is no mapping", "Begin with `title: ...` and `preset: ...`.")
    scale = content.pop("tiny", None)
    if tiny:
        if not isinstance(scale, dict):
            raise _refusal(path.name, "has no section `tiny`", "Leave out --tiny, or add one.")
        base = {**(content.get("base") or {}), **(scale.get("base") or {})}
        content = {**content, **scale, "base": base}
    return _experiment(path, content)


_KINDS: dict[str, type] = {
    **dict.fromkeys(("name", "title", "preset", "plot", "paper_data"), str),
    **dict.fromkeys(("variants", "subjects", "seeds", "metrics"), list),
    **dict.fromkeys(("grid", "base", "cross_identity"), dict),
}
_SAID = {str: "text", list: "a list", dict: "a mapping"}


def _experiment(path: Path, content: Mapping[str, Any]) -> Experiment:
    where = path.name
    _require_known(where, content, _KINDS)
    for key, value in content.items():
        if value is not None and not isinstance(value, _KINDS[key]):
            raise _refusal(where, f"has {key}: {value!r}", f"Give {_SAID[_KINDS[key]]} there.")
    given = {key: value for key, value in content.items() if value is not None}
    for key in ("title", "preset"):
        if key not in given:
            raise _refusal(where, f"lacks `{key}`", f"Add `{key}: ...`.")
    given.setdefault("name", path.stem)
    variants = _variants(where, given.pop("variants", None), given.pop("grid", None))
    for key in ("subjects", "metrics"):
        if key in given and not all(isinstance(item, str) for item in given[key]):
            raise _refusal(where, f"has {key}: {given[key]!r}", "Give a list of texts.")
    if any(not isinstance(seed, int) or seed < 0 for seed in given.get("seeds", ())):
        raise _refusal(where, f"has seeds: {given['seeds']!r}", "Give whole numbers, 0 or more.")
    _require_known(f"{where}, metrics", given.get("metrics", ()), METRICS)
    _check_cross_identity(where, given.get("cross_identity"), given.get("metrics", ()))
    lists = {key: tuple(value) for key, value in given.items() if isinstance(value, list)}
    return Experiment(variants=variants, folder=path.parent.resolve(), **{**given, **lists})


def _check_cross_identity(
    where: str, named: Mapping[Any, Any] | None, metrics: Sequence[str]
) -> None:
    if named is None:
        if {"aed", "apd", "csim"} & set(metrics):
            remedy = "Name a driver: `cross_identity: {driver:`."
            raise _refusal(where, "lists cross-identity metrics", remedy)
        return
    _require_known(f"{where}, cross_identity", named, _CROSS_IDENTITY)
    if "driver" not in named or not all(isinstance(value, str) for value in named.values()):
        cause = f"has cross_identity: {dict(named)!r}"
        raise _refusal(where, cause, "Give texts, with a `driver`.")


def _variants(
    where: str, listed: Sequence[Any] | None, grid: Mapping[str, Any] | None
) -> tuple[Variant, ...]:
    """The rows, in order; a grid multiplies the variants that are listed."""
    rows = [_variant(where, entry) for entry in listed] if listed else [Variant("")]
    if not grid:
        if not listed:
            raise _refusal(where, "varies nothing", "List `variants`, or give a `grid`.")
        return tuple(rows)
    for key, values in grid.items():
        if not isinstance(values, list) or not values:
            raise _refusal(where, f"has grid: {key}: {values!r}", "Give a list of values.")
    points = [dict(zip(grid, point)) for point in itertools.product(*grid.values())]
    return tuple(
        Variant(_joined(row.name, point), {**row.overrides, **point}, row.paper, row.name)
        for row in rows
        for point in points
    )


def _joined(name: str, point: Overrides) -> str:
    told = ", ".join(f"{key.rsplit('.', 1)[-1]} {value}" for key, value in point.items())
    return f"{name}, {told}" if name else told


def _variant(where: str, entry: Any) -> Variant:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise _refusal(where, f"has the variant {entry!r}", "Give each a `name` and a `set`.")
    _require_known(f"{where}, variant {entry['name']!r}", entry, ("name", "set", "paper"))
    overrides, paper = entry.get("set") or {}, entry.get("paper") or {}
    if not isinstance(overrides, dict) or not isinstance(paper, dict):
        cause = f"has the variant {entry['name']!r} with no mapping"
        raise _refusal(where, cause, "`set` and `paper` are mappings.")
    _require_known(f"{where}, paper of {entry['name']!r}", paper, METRICS)
    return Variant(entry["name"], dict(overrides), {key: float(v) for key, v in paper.items()})


def _require_known(where: str, given: Collection[Any], known: Collection[str]) -> None:
    for key in given:
        if key not in known:
            raise _refusal(where, f"has the unknown key {key!r}", nearest(str(key), known))


def nearest(key: str, known: Collection[str]) -> str:
    """A remedy for a misspelt key: the nearest known one, or all of them."""
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    return f"Did you mean {close[0]!r}?" if close else f"Known are {', '.join(sorted(known))}."


def _refusal(where: str, cause: str, remedy: str) -> UserError:
    return UserError(f"The experiment {where} {cause}.", remedy)
