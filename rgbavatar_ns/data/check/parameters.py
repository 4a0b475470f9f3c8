"""Parameters and cameras in numbers, and which of them are odd."""

from dataclasses import dataclass

import numpy as np
import torch

from rgbavatar_ns.data.check.problems import Problem
from rgbavatar_ns.data.importers.formats import FORMATS
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.errors import first_few

_LARGEST_COEFFICIENT, _LARGEST_TURN_RAD = 12.0, np.pi + 0.01
_NARROWEST_DEGREES, _WIDEST_DEGREES = 3.0, 120.0
_NEAREST_M, _FARTHEST_M = 0.1, 20.0
_FLAME_2023 = ("VHAP", "raw VHAP")
"""Systems that track with this version, and can be told to use another; all others use 2020."""


@dataclass(frozen=True)
class FieldRange:
    """One field of theta over all frames."""

    name: str
    size: int
    smallest: float
    largest: float
    changes: bool
    is_angle: bool = False
    """In radians."""

    def __str__(self) -> str:
        """A line of the report; angles in degrees."""
        still = "" if self.changes else ", the same in all frames"
        low, high, unit = self.smallest, self.largest, ""
        if self.is_angle:
            low, high, unit = np.degrees(low), np.degrees(high), " degrees"
        return f"{self.name} ({self.size}): {low:.3g} to {high:.3g}{unit}{still}"


def field_ranges(dataset: TrackedDataset) -> tuple[FieldRange, ...]:
    """The range of each field of theta."""
    parts = dataset.layout.split(dataset.theta)
    return tuple(
        FieldRange(
            name,
            part.shape[1],
            float(part.min()),
            float(part.max()),
            bool((part != part[:1]).any()),
            field.form == "axis_angle",
        )
        for field in dataset.layout.fields
        for name, part in [(field.name, parts[field.name])]
        if part.numel()
    )


def parameter_problems(dataset: TrackedDataset) -> list[Problem]:
    """Coefficients and turns that no head makes, a theta that never changes."""
    problems = []
    parts = dataset.layout.split(dataset.theta)
    for field in dataset.layout.fields:
        part = parts[field.name]
        if field.form == "axis_angle":
            odd, what = part.norm(dim=1) > _LARGEST_TURN_RAD, "turns of more than half a circle"
        elif field.form == "linear":
            odd = part.abs().amax(1) > _LARGEST_COEFFICIENT if part.numel() else torch.zeros(0)
            what = f"coefficients beyond {_LARGEST_COEFFICIENT:.0f}"
        else:
            continue
        frames = tuple(n for n, is_odd in zip(dataset.frame_index, odd.tolist()) if is_odd)
        if frames:
            problems.append(
                Problem(
                    "parameters",
                    "warning",
                    f"{field.name} has {what} in {len(frames)} of {len(dataset)} frames "
                    f"({first_few(frames)}).",
                    "Look at these frames in the tracker; leave them out if it lost the face.",
                    frames,
                )
            )
    if len(dataset) > 1 and not (dataset.theta != dataset.theta[:1]).any():
        moving = bool((dataset.cameras.world_to_camera != dataset.cameras.world_to_camera[0]).any())
        problems.append(
            Problem(
                "parameters",
                "warning" if moving else "error",
                f"theta is the same in all {len(dataset)} frames.",
                "An avatar learns from changing expressions: check how the parameters were read.",
            )
        )
    return problems


def camera_problems(dataset: TrackedDataset) -> list[Problem]:
    """Angles of view, principal points and distances that are not those of a portrait."""
    cameras = dataset.cameras
    focal = cameras.focal_px.numpy()
    size = np.array([dataset.width, dataset.height])
    angles = np.degrees(2 * np.arctan(size / (2 * focal)))
    center = cameras.principal_point_px.numpy()
    eye = torch.linalg.inv(cameras.world_to_camera.double())[:, :3, 3].numpy()
    head = dataset.arrays.v_template.mean(0)
    if "translation" in dataset.layout:
        head = head + dataset.layout.split(dataset.theta)["translation"].numpy()
    distance = np.linalg.norm(eye - head, axis=1)
    found = []
    for odd, what, remedy in (
        (
            (angles < _NARROWEST_DEGREES) | (angles > _WIDEST_DEGREES),
            f"an angle of view of {angles.min():.1f} to {angles.max():.1f} degrees",
            "Check the focal length in pixels, for images of this size.",
        ),
        (
            (center < 0) | (center > size),
            "a principal point outside of the image",
            "Check that it is in pixels, for images of this size.",
        ),
        (
            ((distance < _NEAREST_M) | (distance > _FARTHEST_M))[:, None],
            f"a distance of {distance.min():.2g} to {distance.max():.2g} m from the head",
            "Check the unit of translations: metres are meant.",
        ),
    ):
        frames = tuple(n for n, bad in zip(dataset.frame_index, odd.any(1).tolist()) if bad)
        if frames:
            cause = f"{len(frames)} of {len(dataset)} cameras have {what} ({first_few(frames)})."
            found.append(Problem("cameras", "warning", cause, remedy, frames))
    return found


def version_problem(dataset: TrackedDataset) -> Problem | None:
    """Whether the head is another FLAME than the data's; a warning where it was asked for."""
    told = str(dataset.source.get("format", ""))
    usual, name = "2023" if told in _FLAME_2023 else "2020", dataset.arrays.name
    version = name.removeprefix("FLAME ").removesuffix(" female").removesuffix(" male")
    if told not in (known.name for known in FORMATS) or version == usual:
        return None
    options = dataset.source.get("options")
    said = isinstance(options, dict) and options.get("flame_version") == version
    possible = name.startswith("FLAME") and (said or told in _FLAME_2023)
    return Problem(
        "FLAME version",
        "warning" if possible else "error",
        f"The data comes from {told}, which tracks with FLAME {usual}, but its head is '{name}': "
        "coefficients of one version give another face in the other.",
        f"Import it again with the pickle of FLAME {usual}"
        + (", unless it was tracked with this one." if possible else "."),
    )
