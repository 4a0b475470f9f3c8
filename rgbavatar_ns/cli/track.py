"""`rgbavatar track`: a video of a head becomes a dataset."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from rgbavatar_ns.cli.console import command_line, plain_console
from rgbavatar_ns.cli.progress import stage_bars
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import written_json
from rgbavatar_ns.tracking import TrackConfig, track_video

_FOLLOWED = 0.5
"""Share of the frames in which clothes must be followed for it to be said that they were."""


def run(
    paths: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO [VIDEO ...] DATASET")
    ] = (),
    config: Annotated[TrackConfig, tyro.conf.arg(name="")] = TrackConfig(),
) -> None:
    """Find the face, cut out the person, fit the head model and write a dataset.

    An interrupted command goes on where it was when it is given again.

    Args:
        paths: one file, a folder of images, or several clips of one person; then the folder of
            the dataset.
        config: options of the tracker.
    """
    if len(paths) < 2:
        raise UserError(
            "A video and a place for the dataset are needed.",
            "Try `rgbavatar track me.mp4 data/me`.",
        )
    *videos, dst = paths
    try:
        with stage_bars("frames") as update:
            dataset = track_video(videos, dst, config, progress=update)
    except KeyboardInterrupt:
        print(
            f"rgbavatar track: interrupted; what is done is kept in {dst}, and the same command "
            "goes on from there.",
            file=sys.stderr,
        )
        sys.exit(130)
    report = written_json(dst / "tracking.json")
    console = plain_console()
    console.print(summary_table(report))
    console.print(f"{report['verdict']}", style="bold")
    for line in report["film"]["in_words"]:
        console.print(line)
    for note in report["notes"]:
        console.print(f"note: {note}")
    console.print(
        f"{len(dataset.train)} frames to train on, {len(dataset.test)} held out, in {dst}"
    )
    console.print(f"Look at {dst / 'overlay.png'}: the mesh should lie on the face.")
    for problem in report["refused"]:
        console.print(f"It cannot be trained on. {problem['cause']} {problem['remedy']}")
    if report["refused"]:
        return
    train = command_line("ns-train", suited_method(dataset.width), "--data", dst)
    console.print(f"Then: {train}")


def suited_method(image_size: int) -> str:
    """The method for a tracked video's images of so many pixels."""
    from rgbavatar_ns.tracking.image.crop import SHARP_PX

    return "rgbavatar-quick" if image_size >= SHARP_PX else "rgbavatar-tiny"


def summary_table(report: Mapping[str, Any]) -> Table:
    """The figures of `tracking.json` that tell whether the clip was tracked well."""
    table = Table(show_header=False, box=None)
    rejected = {why: len(frames) for why, frames in report["rejected"].items() if frames}
    without = ", ".join(f"{count} {why}" for why, count in rejected.items()) or "none"
    rows = {
        "frames": f"{report['frames_tracked']} of {report['frames_read']} tracked, "
        f"in {_counted(len(report['segments']), 'stretch', 'stretches')}",
        "left out": without,
        "reprojection error": f"{_percent(report['mesh_reprojection_error_share'])} of the face's "
        f"height, {_percent(report['reprojection_error_share'])} with landmark offsets; "
        f"worst frame {_percent(report['worst_frame_error_share'])}",
        "silhouette": f"matte holds {_percent(report['silhouette_coverage'])} of the head, "
        f"{_percent(report['mesh_outside_matte'])} stand out of it; "
        f"IoU between chin and eyes {_share(report['face_silhouette_iou'])}",
        "mouth, eyelids": f"correlation of fitted and measured opening "
        f"{_share(report['mouth_opening_correlation'])}, "
        f"{_share(report['eyelid_opening_correlation'])}",
        "blinks": f"{report['blinks_fitted']} fitted, {report['blinks_measured']} measured",
        "face": f"{report['face_height_px']:.0f} pixels high; "
        f"{_counted(len(report['blurred']), 'blurred frame', 'blurred frames')}, "
        f"another face in {_counted(len(report['other_faces']), 'frame', 'frames')}",
        "body": _body_told(report["body"]),
        "speed": ", ".join(
            f"{name} {stage['frames_per_second']:.0f} frames/s"
            for name, stage in report["stages"].items()
            if stage["frames"]
        ),
    }
    if report["frames_per_second"] is not None:
        rows["speed"] += f"; together {report['frames_per_second']:.1f} frames/s"
    for name, value in rows.items():
        table.add_row(name, value)
    return table


def _body_told(body: Mapping[str, Any] | None) -> str:
    if body is None:
        return "the head alone, down to the neck"
    by = ""
    if body["followed_share"] < _FOLLOWED:
        if body["still"] and body["outlined_share"] == 0:
            return "taken to keep still: neither pattern nor outline of clothes tells its motion"
        by = ", mostly by its outline: hardly any pattern of clothes tells it"
    if body["still"]:
        return f"keeps still{by}"
    turned, moved = body["turned_degrees"], body["moved_mm"] / 10
    return f"turns by {turned:.0f} degrees, moves by {moved:.0f} cm{by}"


def _percent(share: float | None) -> str:
    return "unknown" if share is None else f"{100 * share:.2f} %"


def _share(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f}"


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"
