"""An experiment as a YAML file: a preset, what is varied, over which subjects and seeds."""

import difflib
import itertools
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.columns import COLUMNS
from rgbavatar_ns.files import digest

_CROSS_IDENTITY = ("driver", "tracker", "face_recognition")


class _Loader(yaml.SafeLoader):
    """As the safe one, which follows YAML 1.1; 8e-4 and 1.5e3 are numbers too, as in 1.2."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)


Overrides = dict[str, Any]
"""Dotted fields of a preset's config, as on ns-train's command line, with their values."""

Published = Mapping[str, float]
"""Figures of the paper by metric."""


@dataclass(frozen=True)
class Variant:
    """One row of the table: what it changes, and what the paper published for it.

    Rows that a grid made of one listed variant share its `family`, a line of a plot. `preset`
    replaces the experiment's. `paper_by_subject` has published figures by a subject's name.
    """

    name: str
    overrides: Overrides = field(default_factory=dict)
    paper: Published = field(default_factory=dict)
    family: str = ""
    preset: str | None = None
    paper_by_subject: Mapping[str, Published] = field(default_factory=dict)


@dataclass(frozen=True)
class SpecText:
    """The file of an experiment, and how it was read: what makes it again elsewhere."""

    file: str
    """As it was named; its name alone where that was an absolute path."""
    text: str
    tiny: bool = False
    subjects: tuple[str, ...] | None = None


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
    spec_text: SpecText | None = None
    """What it was read from; None of one that was made in Python."""

    def __post_init__(self) -> None:
        for what in ("variants", "subjects", "seeds"):
            if not getattr(self, what):
                raise _refusal(self.name, f"has no {what}", f"List at least one under `{what}`.")
        names = [variant.name for variant in self.variants]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            cause = f"has two variants named {twice[0]!r}"
            raise _refusal(self.name, cause, "Give each its own name.")


def read_experiment(
    path: Path, *, tiny: bool = False, subjects: Sequence[str] | None = None
) -> Experiment:
    """Read and check a YAML file; `tiny` applies its section of that name.

    `subjects` replace the file's: folders relative to the working directory, or the procedural
    ones; the experiment's name then tells them. Keys: name, title, preset, variants (name, preset,
    set, paper, paper_by_subject), grid (override -> values; each combination is a variant),
    subjects, seeds, base, metrics, plot, paper_data, tiny (any of these anew, but its base is added
    to the file's). Options may be written with - for _, as on command lines. Raises UserError
    naming the key for anything unknown, missing or of a wrong type. Whether overrides fit the
    preset is checked by `overrides.check_overrides`.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(path, error) from None
    return parse_experiment(text, path, tiny=tiny, subjects=subjects)


def parse_experiment(
    text: str, path: Path, *, tiny: bool = False, subjects: Sequence[str] | None = None
) -> Experiment:
    """`read_experiment` of a file's text; `path` names it, and subjects are relative to it."""
    try:
        content = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise _unreadable(path, error) from None
    if not isinstance(content, dict):
        raise _refusal(path.name, "is no mapping", "Begin with `title: ...` and `preset: ...`.")
    scale = content.pop("tiny", None)
    if tiny:
        if not isinstance(scale, dict):
            raise _refusal(path.name, "has no section `tiny`", "Leave out --tiny, or add one.")
        base = {
            **_options(path.name, content.get("base")),
            **_options(path.name, scale.get("base")),
        }
        content = {**content, **scale, "base": base}
    named = path.name if path.is_absolute() else path.as_posix()
    spec_text = SpecText(named, text, tiny, None if subjects is None else tuple(subjects))
    experiment = replace(_experiment(path, content), spec_text=spec_text)
    return experiment if subjects is None else _of_subjects(experiment, subjects)


def _unreadable(path: Path, error: Exception) -> UserError:
    return UserError(f"{path} cannot be read: {error}.", "Check the path and its YAML.")


def _of_subjects(experiment: Experiment, subjects: Sequence[str]) -> Experiment:
    """The same on other subjects, by another name, so that results do not mix."""
    placed = tuple(
        name if is_demo(name) else str(Path(name).expanduser().absolute()) for name in subjects
    )
    return replace(experiment, name=name_on(experiment.name, placed), subjects=placed)


def name_on(name: str, subjects: Sequence[str]) -> str:
    """An experiment's name on other subjects; two folders of one name part by the digest in it."""
    parts = [part.replace(":", "-") if is_demo(part) else Path(part).name for part in subjects]
    told = "-".join(parts[:3]) + (f"-and-{len(parts) - 3}-more" if len(parts) > 3 else "")
    return f"{name}-{told}-{digest(subjects)[:6]}"


def is_demo(subject: str) -> bool:
    """Whether it is "demo", "demo:SEED", "demo:SEED:FRAMES" or "demo:SEED:FRAMES:SIZE"."""
    kind, *numbers = subject.split(":")
    return kind == "demo" and len(numbers) <= 3 and all(number.isdigit() for number in numbers)


def subject_name(subject: str) -> str:
    """What tables call a subject: a folder's name, or the procedural one as it is."""
    return subject if is_demo(subject) else Path(subject).name


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
    for key in ("base", "grid"):
        if key in given:
            given[key] = _options(where, given[key])
    if "plot" in given:
        given["plot"] = _option(given["plot"])
    variants = _variants(where, given.pop("variants", None), given.pop("grid", None))
    for key in ("subjects", "metrics"):
        if key in given and not all(isinstance(item, str) for item in given[key]):
            raise _refusal(where, f"has {key}: {given[key]!r}", "Give a list of texts.")
    if any(not isinstance(seed, int) or seed < 0 for seed in given.get("seeds", ())):
        raise _refusal(where, f"has seeds: {given['seeds']!r}", "Give whole numbers, 0 or more.")
    _require_known(f"{where}, metrics", given.get("metrics", ()), COLUMNS)
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
        replace(
            row,
            name=_joined(row.name, point),
            overrides={**row.overrides, **point},
            family=row.name,
        )
        for row in rows
        for point in points
    )


def _joined(name: str, point: Overrides) -> str:
    told = ", ".join(f"{key.rsplit('.', 1)[-1]} {value}" for key, value in point.items())
    return f"{name}, {told}" if name else told


def _variant(where: str, entry: Any) -> Variant:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise _refusal(where, f"has the variant {entry!r}", "Give each a `name` and a `set`.")
    named = f"{where}, variant {entry['name']!r}"
    _require_known(named, entry, ("name", "preset", "set", "paper", "paper_by_subject"))
    preset = entry.get("preset")
    if preset is not None and not isinstance(preset, str):
        raise _refusal(named, f"has preset: {preset!r}", "Give text there.")
    parts = {key: entry.get(key) or {} for key in ("set", "paper", "paper_by_subject")}
    wrong = [key for key, value in parts.items() if not isinstance(value, dict)]
    if wrong:
        raise _refusal(named, f"has {wrong[0]}: {parts[wrong[0]]!r}", "Give a mapping there.")
    return Variant(
        entry["name"],
        _options(named, parts["set"]),
        _published(f"{where}, paper of {entry['name']!r}", parts["paper"]),
        preset=preset,
        paper_by_subject={
            str(subject): _published(f"{named}, paper of {subject}", figures)
            for subject, figures in parts["paper_by_subject"].items()
        },
    )


def _published(where: str, figures: Any) -> dict[str, float]:
    if not isinstance(figures, dict) or not all(
        isinstance(value, int | float) for value in figures.values()
    ):
        raise _refusal(where, f"has {figures!r}", "Give figures by metric.")
    _require_known(where, figures, COLUMNS)
    return {key: float(value) for key, value in figures.items()}


def _option(name: Any) -> str:
    """An option's one spelling: fields are written with _, command lines with - too."""
    return str(name).replace("-", "_")


def _options(where: str, given: Mapping[Any, Any] | None) -> Overrides:
    if given is not None and not isinstance(given, dict):
        raise _refusal(where, f"has the options {given!r}", "Give a mapping there.")
    options: Overrides = {}
    for name, value in (given or {}).items():
        if _option(name) in options:
            raise _refusal(where, f"sets {_option(name)} twice", "Leave one of its spellings.")
        options[_option(name)] = value
    return options


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
