"""What was swept, kept beside the cells: a report needs the folder alone."""

import shlex
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.spec import (
    Experiment,
    SpecText,
    name_on,
    parse_experiment,
    subject_name,
)
from rgbavatar_ns.files import read_json, write_json

_SUFFIX = ".source.json"


@dataclass(frozen=True)
class Source:
    """An experiment as it was swept, and by which command."""

    experiment: Experiment
    tiny: bool
    command: str
    """Without this machine's paths: datasets by their names."""
    name: str
    """Of its results: the same on every machine, where the experiment's tells this one's paths."""


def keep_source(folder: Path, experiment: Experiment) -> None:
    """Leave in a sweep's folder the text of its file and how it was read, if it was read."""
    if experiment.spec_text is not None:
        write_json(folder / f"{experiment.name}{_SUFFIX}", asdict(experiment.spec_text))


def swept_names(folder: Path) -> set[str]:
    """The names of the experiments that were swept into `folder` from files."""
    return {path.name.removesuffix(_SUFFIX) for path in folder.glob(f"*{_SUFFIX}")}


def read_sources(folder: Path) -> list[Source]:
    """All experiments that were swept into `folder`, by name.

    Raises UserError where there is none, or one that says nothing.
    """
    found = sorted(folder.glob(f"*{_SUFFIX}"))
    if not found:
        raise UserError(
            f"{folder} does not say what was swept there.",
            "Name a folder that `rgbavatar sweep FILE` wrote. One of an earlier version: call its "
            "sweep again, which keeps finished cells.",
        )
    return [_read(path) for path in found]


def _read(path: Path) -> Source:
    content = read_json(path)
    try:
        subjects = None if content["subjects"] is None else tuple(content["subjects"])
        spec = SpecText(**{**content, "subjects": subjects})
        experiment, of_file = (
            parse_experiment(spec.text, Path(spec.file), tiny=spec.tiny, subjects=named)
            for named in (spec.subjects, None)
        )
    except (TypeError, KeyError, AttributeError):
        raise UserError(
            f"{path} does not say what was swept.", "Call the same `rgbavatar sweep` again."
        ) from None
    # The name tells subjects of the command line by their paths from where it was called.
    experiment = replace(experiment, name=path.name.removesuffix(_SUFFIX))
    command, name = f"rgbavatar sweep {spec.file}", of_file.name
    if spec.tiny:
        command += " --tiny"
    if spec.subjects is not None:
        names = [subject_name(subject) for subject in spec.subjects]
        command += f" --subjects {shlex.join(names)}"
        name = name_on(name, names)
    return Source(experiment, spec.tiny, command, f"{name}-tiny" if spec.tiny else name)
