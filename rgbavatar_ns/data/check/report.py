"""The check of a dataset: what is in it, what is odd, and whether it can be trained."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rgbavatar_ns.data.check.contact_sheet import MAX_TILES, write_check_sheet
from rgbavatar_ns.data.check.film import FilmFacts, film_facts
from rgbavatar_ns.data.check.parameters import (
    FieldRange,
    camera_problems,
    field_ranges,
    parameter_problems,
    version_problem,
)
from rgbavatar_ns.data.check.placement import mirrored_problem, placement_problem
from rgbavatar_ns.data.check.problems import Problem, usable
from rgbavatar_ns.data.check.sample import (
    Sample,
    inside_share,
    overlaps,
    projected,
    spread,
    take_sample,
)
from rgbavatar_ns.data.check.silhouette import SilhouetteOverlap
from rgbavatar_ns.data.check.timing import frame_offset_problem, longest_run
from rgbavatar_ns.data.importers import find_format
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.data.native.format import FORMAT, INDEX_FILE
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.files import DiskError

_FEW_SPREAD = 4
"""Frames that are enough to see whether the head is where the images show it."""
_FEW_FRAMES, _LOW_OF_MEDIAN, _HALF = 30, 0.75, 0.5


@dataclass(frozen=True)
class CheckReport:
    """What `rgbavatar check` tells; `usable` where no problem is an error."""

    path: Path
    format: str
    frames: int
    problems: tuple[Problem, ...]
    train: int = 0
    test: int = 0
    head: str = ""
    size: tuple[int, int] = (0, 0)
    num_cameras: int = 0
    moving: bool = False
    """Whether a camera stands in several places or has several focal lengths."""
    focal_px: tuple[float, float] = (0.0, 0.0)
    ranges: tuple[FieldRange, ...] = ()
    film: FilmFacts | None = None
    """None where the images cannot be read."""
    notes: tuple[str, ...] = ()
    iou: dict[int, float] = field(default_factory=dict)
    """Overlap of head mesh and matte by frame number, of the frames that were looked at."""
    sheet: Path | None = None
    unfilmed: float = 0.0
    """Mean share of an image that nobody filmed, of the frames that were looked at."""

    @property
    def usable(self) -> bool:
        """Whether training can go on."""
        return usable(self.problems)

    def to_json(self) -> dict[str, Any]:
        """For programs: `format`, `frames`, `usable`, `problems`, and the figures behind them."""
        return {
            "format": self.format,
            "frames": self.frames,
            "usable": self.usable,
            "problems": [problem.to_json() for problem in self.problems],
            "train": self.train,
            "test": self.test,
            "head": self.head,
            "size": list(self.size),
            "cameras": self.num_cameras,
            "moving": self.moving,
            "focal_px": list(self.focal_px),
            "film": None if self.film is None else self.film.to_json(),
            "parameters": {r.name: [r.smallest, r.largest] for r in self.ranges},
            "notes": list(self.notes),
            "iou": {str(number): round(value, 4) for number, value in self.iou.items()},
            "unfilmed": round(self.unfilmed, 4),
            "sheet": None if self.sheet is None else str(self.sheet),
        }


def unreadable_report(path: Path, error: UserError) -> CheckReport:
    """The report on data that its reader refused; its format is told where it can be."""
    foreign = find_format(path) if path.is_dir() else None
    told = "unknown" if foreign is None else foreign.name
    if (path / INDEX_FILE).is_file():
        told = FORMAT
    return CheckReport(path, told, 0, (Problem.of_error(error),))


def quick_check(dataset: TrackedDataset) -> list[Problem]:
    """Errors that a few frames tell in a second; raises UserError naming a damaged image."""
    train = dataset.train
    positions = [train[place] for place in spread(len(train), _FEW_SPREAD)]
    problem = placement_problem(take_sample(dataset, positions), only_hopeless=True)
    found = [problem, version_problem(dataset)]
    return [one for one in found if one is not None and one.severity == "error"]


def check_dataset(
    dataset: TrackedDataset,
    max_frames: int = 200,
    sheet: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport:
    """Look at up to `max_frames` frames, evenly spread, and at a run of frames one after another.

    sheet: where the contact sheet goes (PNG). Images that cannot be decoded become problems.
    """
    positions = spread(len(dataset), max_frames).tolist()
    problems = [*parameter_problems(dataset), *camera_problems(dataset)]
    problems += [one for one in [version_problem(dataset)] if one is not None]
    found_overlaps, unfilmed, film = [], 0.0, None
    try:
        sample = take_sample(dataset, positions, progress)
        unfilmed = float(1 - sample.filmed.mean())
        film = film_facts(dataset, sample)
        found_overlaps = overlaps(sample, projected(sample))
        found = _image_problems(dataset, sample, found_overlaps)
        if sheet is not None:
            shown = spread(len(sample), MAX_TILES).tolist()
            try:
                write_check_sheet(sheet, dataset, sample, found_overlaps, shown)
            except DiskError as error:
                found.append(_no_sheet(error))
                sheet = None
    except UserError as error:
        found, sheet = [Problem.of_error(error)], None
    problems = sorted([*found, *problems], key=lambda problem: problem.severity)
    focal = dataset.cameras.focal_px
    views = np.concatenate(
        [dataset.cameras.world_to_camera.flatten(1), focal, dataset.cameras.principal_point_px], 1
    )
    num_cameras = len(set(dataset.camera_names)) or 1
    return CheckReport(
        dataset.root,
        str(dataset.source.get("format") or FORMAT),
        len(dataset),
        tuple(problems),
        len(dataset.train),
        len(dataset.test),
        dataset.arrays.name,
        (dataset.width, dataset.height),
        num_cameras,
        len(np.unique(views, axis=0)) > num_cameras,
        (float(focal.min()), float(focal.max())),
        field_ranges(dataset),
        film,
        tuple(map(str, dataset.source.get("notes", ()))),
        {dataset.frame_index[p]: one.iou for p, one in zip(positions, found_overlaps)},
        sheet,
        unfilmed,
    )


def _no_sheet(error: DiskError) -> Problem:
    remedy = "Name another place for the contact sheet with --sheet; the report is whole."
    return Problem("sheet", "warning", error.cause, remedy)


def _image_problems(
    dataset: TrackedDataset, sample: Sample, found_overlaps: list[SilhouetteOverlap]
) -> list[Problem]:
    placement = placement_problem(sample.select(spread(len(sample), _FEW_SPREAD).tolist()))
    problems: list[Problem | None] = [placement]
    if placement is None or placement.severity == "warning":
        problems.append(mirrored_problem(sample))
        problems.append(frame_offset_problem(take_sample(dataset, longest_run(dataset))))
        problems += _odd_frames(dataset, sample, found_overlaps)
    problems.append(_mattes(sample))
    if len(dataset.train) < _FEW_FRAMES:
        problems.append(
            Problem(
                "parameters",
                "warning",
                f"There are only {len(dataset.train)} frames to train from.",
                "Expect a poor avatar; some hundred frames with speech and head turns are usual.",
            )
        )
    return [problem for problem in problems if problem is not None]


def _odd_frames(
    dataset: TrackedDataset, sample: Sample, found_overlaps: list[SilhouetteOverlap]
) -> list[Problem]:
    """Single frames whose head is not in the image or leaves the matte, where most are right."""
    covered = np.array([one.covered for one in found_overlaps])
    found = []
    for kind, odd, what, remedy in (
        (
            "outside",
            inside_share(sample, projected(sample)) < _HALF,
            "the projected head lies outside of the image",
            "Leave these frames out: the tracker lost the face there.",
        ),
        (
            "misfit",
            covered < _LOW_OF_MEDIAN * np.median(covered) if found_overlaps else covered,
            "the mesh leaves the person far more than in the others",
            "Look at these frames; leave them out if the tracker lost the face.",
        ),
    ):
        frames = tuple(dataset.frame_index[p] for p, bad in zip(sample.positions, odd) if bad)
        if frames:
            cause = f"In {len(frames)} of {len(sample)} frames {what} ({first_few(frames)})."
            found.append(Problem(kind, "warning", cause, remedy, frames))
    return found


def _mattes(sample: Sample) -> Problem | None:
    if not sample.has_mattes:
        return Problem(
            "mattes",
            "warning",
            "The images are opaque: the person is not cut out, so that no silhouette can be "
            "compared.",
            "Cut the person out (alpha 255 is the person), or the background is learned too.",
        )
    if (sample.alpha > _HALF).mean() >= 0.005:
        return None
    return Problem(
        "mattes",
        "error",
        "The images are empty: their alpha is zero nearly everywhere.",
        "Check the mattes; alpha 255 is the person, 0 the background.",
    )
