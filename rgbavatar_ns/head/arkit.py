"""The 52 ARKit blend shapes as a head model's theta: one table a head, and its way back."""

import difflib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arrays import NECK_SHIFTS, HeadArrays
from rgbavatar_ns.head.layout import CARRIER_FIELDS, ThetaLayout
from rgbavatar_ns.head.model import layout_of
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle

ARKIT_NAMES = (
    "eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft",
    "eyeSquintLeft", "eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight",
    "eyeLookOutRight", "eyeLookUpRight", "eyeSquintRight", "eyeWideRight", "jawForward",
    "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft",
    "mouthRight", "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft", "mouthFrownRight",
    "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight",
    "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthPressLeft",
    "mouthPressRight", "mouthLowerDownLeft", "mouthLowerDownRight", "mouthUpperUpLeft",
    "mouthUpperUpRight", "browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft",
    "browOuterUpRight", "cheekPuff", "cheekSquintLeft", "cheekSquintRight", "noseSneerLeft",
    "noseSneerRight", "tongueOut",
)  # fmt: skip
"""In the order of Unreal Engine's EARFaceBlendShape, which Live Link Face sends."""

_JAW_OPEN_RAD = 0.426
"""By which MakeHuman's sculpted jawOpen turns the jaw about its hinge: 24.4 degrees. The jaw is a
joint here, and so it is opened in everything that an avatar has seen."""
_GAZE_RAD = {"pitch": 0.45, "yaw": 0.55}
"""An eye's turn at 1; ours, because ARKit says only that 1 is the farthest: as far as eyes go that
a camera before the face still sees (`tracking.fit.parameters`)."""
_LOOKS = {"Down": ("pitch", 1), "Up": ("pitch", -1), "In": ("yaw", -1), "Out": ("yaw", 1)}
"""Axis and sign of the left eye's turn; the right one's yaw is the mirror image."""

Turns = Literal["rotation", "neck"]


@dataclass(frozen=True)
class ArkitMap:
    """How ARKit's coefficients, each from 0 to 1, and the head's turn make a theta."""

    layout: ThetaLayout
    theta_per_unit: Float[np.ndarray, "52 H"]
    """Rows in the order of `ARKIT_NAMES`; zeros where the head cannot do it."""
    turns: Turns
    """The field that carries the head: `neck` of a head with shoulders, which stay."""
    unexplained: Float[np.ndarray, "52"]
    """The share of each expression's motion, by size, that this head cannot follow."""

    def theta(
        self,
        coefficients: Float[Tensor, "*batch 52"],
        head_rotation: Float[Tensor, "*batch 3"] | None = None,
    ) -> Float[Tensor, "*batch H"]:
        """Theta of coefficients, held to [0, 1], and the head's turn (axis-angle, radians).

        The turn is in the head's axes: x the subject's left, y up, z out of the face.
        """
        table = torch.as_tensor(self.theta_per_unit).to(coefficients)
        theta = coefficients.clamp(0, 1) @ table
        if head_rotation is not None:
            theta[..., self.layout.slice(self.turns)] = head_rotation.to(theta)
        return theta

    def coefficients(self, theta: Float[Tensor, "*batch H"]) -> Float[Tensor, "*batch 52"]:
        """The coefficients, at least 0, that a theta of a head with ARKit's names stands for."""
        table = torch.as_tensor(self.theta_per_unit).to(theta)
        return (theta @ (table / table.square().sum(1, keepdim=True).clamp(min=1e-12)).mT).clamp(0)

    def head_rotation(self, theta: Float[Tensor, "*batch H"]) -> Float[Tensor, "*batch 3"]:
        """The head's turn in the world, root and neck together (axis-angle, radians)."""
        parts = self.layout.split(theta)
        root, neck = (axis_angle_to_matrix(parts[name]) for name in CARRIER_FIELDS)
        return matrix_to_axis_angle(root @ neck)


def head_carrier(expression_names: Collection[str]) -> Turns:
    """The joint that turns the head: the neck upon a body, which the root carries, or the root."""
    return "neck" if set(NECK_SHIFTS) <= set(expression_names) else "rotation"


def speaks_arkit(arrays: HeadArrays) -> bool:
    """Whether the head's expressions have ARKit's names."""
    return set(ARKIT_NAMES) <= set(arrays.expression_names)


def arkit_map(arrays: HeadArrays) -> ArkitMap:
    """The map for a head: by name where its expressions have ARKit's, else fitted to FLAME's kind.

    Jaw and gaze are joints. Fitting takes seconds (`arkit_fit.fitted_table`). Raises UserError for
    a head of other names on which no face is found.
    """
    layout = layout_of(arrays)
    if speaks_arkit(arrays):
        expression = layout.slice("expression").start
        table = np.zeros((len(ARKIT_NAMES), layout.size))
        for row, name in zip(table, ARKIT_NAMES):
            if not (name == "jawOpen" or name.startswith("eyeLook")):
                row[expression + arrays.expression_names.index(name)] = 1.0
        table[ARKIT_NAMES.index("jawOpen"), layout.slice("jaw").start] = _JAW_OPEN_RAD
        unexplained = np.zeros(len(ARKIT_NAMES))
    else:
        # Takes trimesh and scipy, which drawing a bundle does not need.
        from rgbavatar_ns.head.arkit_fit import fitted_table

        known = arkit_map(HeadArrays.embedded())
        looks = [name.startswith("eyeLook") for name in ARKIT_NAMES]
        faces = np.where(np.array(looks)[:, None], 0.0, known.theta_per_unit)
        table, unexplained = fitted_table(arrays, layout, faces)
    for side, field, mirrored in (("Left", "left_eye", 1), ("Right", "right_eye", -1)):
        start = layout.slice(field).start
        for look, (axis, sign) in _LOOKS.items():
            row = ARKIT_NAMES.index(f"eyeLook{look}{side}")
            turned = sign * (mirrored if axis == "yaw" else 1) * _GAZE_RAD[axis]
            table[row, start + (axis == "yaw")] = turned
            unexplained[row] = 0.0
    return ArkitMap(layout, table, head_carrier(arrays.expression_names), unexplained)


def arkit_coefficients(named: Mapping[str, int | float]) -> Float[Tensor, "52"]:
    """Coefficients by name (`jawOpen`, or `JawOpen` as Live Link Face writes it) as a row.

    Raises UserError for a name that ARKit does not have, and for a value that is no number.
    """
    row = torch.zeros(len(ARKIT_NAMES))
    for name, value in named.items():
        known = name[:1].lower() + name[1:] if isinstance(name, str) else str(name)
        if known not in ARKIT_NAMES:
            near = difflib.get_close_matches(known, ARKIT_NAMES, 1)
            raise UserError(
                f"ARKit has no blend shape '{str(name)[:40]}'.",
                f"Did you mean {near[0]}?" if near else "Use names such as jawOpen.",
            )
        number = _number(value)
        if not math.isfinite(number):
            raise UserError(f"{known} is {value!r:.40}.", "Give a number from 0 to 1.")
        row[ARKIT_NAMES.index(known)] = number
    return row


def _number(value: Any) -> float:
    """The value as a number; NaN where it is none, as text is."""
    try:
        return math.nan if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return math.nan


def arkit_rows(values: Any) -> Float[Tensor, "*batch 52"]:
    """Coefficients by name, or rows of them in the order of `ARKIT_NAMES`, as rows.

    Raises UserError for what is neither, with the number of columns where that is what is wrong.
    """
    if isinstance(values, Mapping):
        return arkit_coefficients(values)
    wanted = (
        f"Give a mapping such as {{'jawOpen': 0.5}}, or a tensor whose last axis has the "
        f"{len(ARKIT_NAMES)} blend shapes in the order of ARKIT_NAMES"
    )
    if not isinstance(values, Tensor):
        raise UserError(f"The ARKit values are {type(values).__name__}.", f"{wanted}.")
    if values.ndim == 0 or values.shape[-1] != len(ARKIT_NAMES):
        raise UserError(
            f"The ARKit values are {list(values.shape)}.",
            f"{wanted}; without timecode, their count, and the turns of head and eyes.",
        )
    return values
