"""`rgbavatar check`: can this data be trained, and if not, why."""

import json
import sys
from pathlib import Path
from typing import Annotated

import tyro

from rgbavatar_ns.cli.progress import progress_bar
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.data.check import CheckReport, check_dataset, unreadable_report
from rgbavatar_ns.data.importers import ImportOptions
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Count


def run(
    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    sheet: Path | None = None,
    max_frames: Count = 200,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    options: Annotated[ImportOptions, tyro.conf.arg(name="")] = ImportOptions(),
) -> None:
    """Look at a dataset before training; exit code 0: usable, 1: not.

    Args:
        data: the dataset's folder.
        sheet: where the contact sheet goes (PNG); by default check.png in a dataset of the
            project's own format, and FOLDER-check.png here for others (from within FOLDER,
            check.png in its import).
        max_frames: how many frames are decoded and compared, evenly spread.
        as_json: print the report as JSON (format, frames, usable, problems and more).
        options: how a folder of another system is read.
    """
    try:
        dataset = load_dataset(data, options)
    except UserError as error:
        report = unreadable_report(data, error)
    else:
        place = _sheet_path(data, dataset.root, sheet)
        if as_json:
            report = check_dataset(dataset, max_frames, place)
        else:
            with progress_bar("check") as update:
                report = check_dataset(dataset, max_frames, place, update)
    if as_json:
        print(json.dumps(report.to_json(), indent=1, allow_nan=False))
    else:
        print(_in_words(data, report))
    if not report.usable:
        sys.exit(1)


def _sheet_path(data: Path, root: Path, sheet: Path | None) -> Path:
    """In a dataset of our own, or here: other systems' folders are left as they are."""
    if sheet is None:
        whole = data.resolve()
        # A new file in another system's folder would have it imported anew.
        if Path.cwd().is_relative_to(whole) or root.resolve() == whole:
            return root / "check.png"
        return Path(f"{whole.name}-check.png")
    if sheet.suffix.lower() != ".png":
        raise UserError(f"The sheet {sheet} is no PNG.", "Let its name end in .png.")
    return sheet


def _in_words(data: Path, report: CheckReport) -> str:
    lines = [f"{data}: {report.format}"]
    if report.frames:
        width, height = report.size
        shared = "one camera" if report.num_cameras == 1 else f"{report.num_cameras} cameras"
        shared += " that moves" if report.moving and report.num_cameras == 1 else ""
        low, high = report.focal_px
        focal = f"{low:.0f}" if high - low < 1 else f"{low:.0f} to {high:.0f}"
        lines += [
            f"  {report.frames} frames ({report.train} to train on, {report.test} held out) of "
            f"{width} x {height} pixels, {shared}, focal length {focal} pixels",
            f"  head model {report.head}",
            *(f"    {line}" for line in report.ranges),
            *(f"  note: {note}" for note in report.notes),
        ]
        if report.film is not None:
            lines += [f"  {line}" for line in (report.film.turns, *report.film.in_words())]
    if report.unfilmed:
        lines.append(
            f"  {report.unfilmed:.1%} of the images were not filmed (hatched in the sheet): they "
            "count neither in training nor in scores"
        )
    if report.iou:
        values = sorted(report.iou.values())
        lines.append(
            f"  overlap of head mesh and mattes (IoU) in {len(values)} frames: "
            f"{values[0]:.2f} to {values[-1]:.2f}, median {values[len(values) // 2]:.2f}"
        )
    if report.sheet is not None:
        lines.append(f"  look at {report.sheet}: the mesh should lie on the face")
    lines += [f"  {p.severity}: {p.kind}. {p.cause} {p.remedy}" for p in report.problems]
    warned = len(report.problems)
    verdict = "It can be trained." if report.usable else "It cannot be trained like this."
    if report.usable and warned:
        verdict += f" See the {f'{warned} warnings' if warned > 1 else 'warning'} first."
    return "\n".join([*lines, verdict])
