"""FLAME for a format: the right version of it, and coefficients brought to its size."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from rgbavatar_ns.data.importers.folder import as_array, finite
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.source import Reading
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.flame import FLAME_VARIABLE, FLAME_VERTICES, load_flame, stated_version
from rgbavatar_ns.head.rotations import matrix_to_axis_angle, rows_6d_to_matrix
from rgbavatar_ns.head.teeth import with_teeth

_SMALLEST_ROW = 1e-3


class FlameVersionError(UserError):
    """The FLAME model at hand is of another version than the data's."""


def flame_for(
    reading: Reading,
    usual_version: str,
    static_offset: Float[np.ndarray, "_ 3"] | None = None,
) -> HeadArrays:
    """The user's FLAME of the version that the data was tracked with, with teeth if wanted.

    static_offset: of the subject's vertices at rest: FLAME's 5,023, or with the 120 of VHAP's
    teeth after them. Raises FlameVersionError where the version is another one.
    """
    options = reading.options
    wanted = options.flame_version or usual_version
    given = options.flame or os.environ.get(FLAME_VARIABLE)
    named = Path(given or "").expanduser()
    is_folder = bool(given) and named.is_dir()
    arrays = load_flame(
        options.flame,
        uv=options.flame_uv,
        eyelids=options.flame_eyelids,
        teeth=False,
        version=wanted if is_folder or options.flame_version else None,
    )
    version = arrays.name.removeprefix("FLAME ").removesuffix(" female").removesuffix(" male")
    if not is_folder:
        # --flame-version says how the data was tracked, not what a pickle is that has a name.
        version = stated_version(named) or version
    if version != wanted:
        raise FlameVersionError(
            f"{reading} is tracked with FLAME {wanted}, but {named} is FLAME {version} by its "
            "name. Each version has expressions and identities of its own, so that coefficients "
            "of one, padded or not, give another face in the other.",
            f"Name the pickle of FLAME {wanted} with --flame; if the data was tracked with "
            f"FLAME {version} after all, say --flame-version '{version}'; if the name is wrong, "
            "mend it.",
        )
    return _with_offset_and_teeth(arrays, static_offset, options.teeth)


def _with_offset_and_teeth(
    arrays: HeadArrays, static_offset: Float[np.ndarray, "_ 3"] | None, teeth: bool
) -> HeadArrays:
    if static_offset is None:
        return with_teeth(arrays) if teeth else arrays
    if teeth and len(static_offset) > FLAME_VERTICES:
        # VHAP places its teeth on the mean lips and moves them by offsets of their own.
        return _moved(with_teeth(arrays, "blocks"), static_offset)
    moved = _moved(arrays, static_offset[:FLAME_VERTICES])
    return with_teeth(moved) if teeth else moved


def _moved(arrays: HeadArrays, offset: Float[np.ndarray, "V 3"]) -> HeadArrays:
    return replace(arrays, v_template=arrays.v_template + offset.astype(np.float32))


def padded(coefficients: Any, count: int, what: str, head_name: str) -> Float[np.ndarray, "_"]:
    """Coefficients in the head model's number; UnusableFrameError if none, or not only zeros go."""
    values = as_array(coefficients, what)
    if values.dtype.kind not in "iuf" or values.size != max(values.shape, default=0):
        raise UnusableFrameError(f"{what} that is no list of numbers")
    values = finite(values.reshape(-1), what)
    if not len(values):
        raise UnusableFrameError(f"no {what}")
    if values[count:].any():
        raise UnusableFrameError(
            f"{what} of {len(values)} coefficients, of which {head_name} keeps {count}"
        )
    return np.pad(values[:count], (0, max(0, count - len(values))))


def require_rotations(rows: Float[np.ndarray, "N 6"], what: str) -> None:
    """Raise UnusableFrameError where some two rows of a matrix give no rotation."""
    first, second = rows[:, :3], rows[:, 3:]
    if np.linalg.norm(np.cross(first, second), axis=1).min() < _SMALLEST_ROW:
        raise UnusableFrameError(f"{what} that is no rotation")


def from_6d_rows(rows: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 3"]:
    """Axis-angle of rotations given by their first two rows."""
    return matrix_to_axis_angle(rows_6d_to_matrix(torch.from_numpy(rows))).numpy()
