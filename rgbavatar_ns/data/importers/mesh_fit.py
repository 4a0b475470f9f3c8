"""Head shape, jaw, eyes and eyelids from meshes that a tracker wrote, where nothing else tells."""

import io
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.source import Reading
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel
from rgbavatar_ns.head.flame import FLAME_VERTICES
from rgbavatar_ns.reading import read_file

_ITERATIONS, _SHAPE_FRAMES, _EVERY = 8, 3, 6
_CONVERGED = 1e-9
_STEP = 1e-4
_DAMPING = 1e-9
_MOST_BYTES = 1 << 26
_WORST_M = 3e-4
"""Meshes farther from the fitted head than this are not of this head model."""
_NOT_FLAMES = "meshes that are not FLAME's"


@torch.no_grad()
def fit_meshes(
    reading: Reading,
    arrays: HeadArrays,
    expressions: dict[int, Float[np.ndarray, "_"]],
    meshes: dict[int, Path],
) -> tuple[Float[np.ndarray, "_"], dict[int, dict[str, Float[np.ndarray, "_"]]]]:
    """Identity, and theta by frame number: Gauss-Newton on vertices, expressions known.

    Ours. The shape comes from a few frames together, then each frame by itself. Raises UserError
    where no head of this model gives the meshes, or all were simplified.
    """
    fit = _Fit(arrays)
    numbers = list(expressions)
    spread = numbers[:: max(1, len(numbers) // _SHAPE_FRAMES)]
    targets: dict[int, Float[Tensor, "V 3"]] = {}
    damaged: set[int] = set()
    # Others take the place of those that cannot be read.
    for number in dict.fromkeys([*spread, *numbers]):
        if len(targets) == _SHAPE_FRAMES:
            break
        damaged.add(number)
        with reading.report.frame(meshes[number].name):
            targets[number] = read_mesh(meshes[number])[fit.kept]
            damaged.remove(number)
    if not targets and reading.report.left_out(_NOT_FLAMES):
        # To leave these out, as the report says, would leave nothing.
        raise UserError(
            f"{reading} has no frames with meshes of FLAME's {FLAME_VERTICES} vertices.",
            "INSTA's generate.sh simplifies the meshes, and what is left does not tell FLAME's "
            "parameters: put metrical-tracker's `checkpoint` folder of this subject into the data.",
        )
    reading.report.settle(str(reading), reading.options.allow_partial)
    if not targets:
        raise reading.no_frames()
    theta = torch.stack([fit.start(expressions[number]) for number in targets])
    identity = fit.shape(theta, torch.stack(list(targets.values())))
    found = {}
    worst = 0.0
    for number in reading.each([n for n in numbers if n not in damaged], "fitting meshes"):
        with reading.report.frame(meshes[number].name):
            target = read_mesh(meshes[number])[fit.kept]
            fitted, error = fit.pose(fit.start(expressions[number]), identity, target)
            worst = max(worst, error)
            parts = fit.head.layout.split(fitted)
            found[number] = {name: part.numpy() for name, part in parts.items()}
    if worst > _WORST_M:
        raise UserError(
            f"{reading} has meshes that {arrays.name} cannot take on: up to {1000 * worst:.2f} mm "
            "lie between them.",
            "Name the FLAME model that the data was tracked with, with its eyelid offsets beside "
            "it, or add the tracker's checkpoint folder.",
        )
    return identity.numpy(), found


def read_mesh(path: Path) -> Float[Tensor, "V 3"]:
    """FLAME's vertices from an OBJ file; raises UnusableFrameError."""
    try:
        lines = (line for line in io.BytesIO(read_file(path, _MOST_BYTES)) if line[:2] == b"v ")
        rows = [line.split(None, 4)[1:4] for line in islice(lines, FLAME_VERTICES)]
        vertices = np.array([[float(word) for word in row] for row in rows], dtype=np.float64)
    except ValueError:
        raise UnusableFrameError("meshes that cannot be read") from None
    if vertices.shape != (FLAME_VERTICES, 3) or not np.isfinite(vertices).all():
        raise UnusableFrameError(_NOT_FLAMES)
    return torch.from_numpy(vertices)


class _Fit:
    """Gauss-Newton on every sixth vertex; of the others only those are kept that joints need."""

    def __init__(self, arrays: HeadArrays) -> None:
        self.kept = np.flatnonzero(
            (np.arange(len(arrays.v_template)) % _EVERY == 0) | arrays.joint_regressor.any(0)
        )
        self.kept = self.kept[self.kept < FLAME_VERTICES]
        self.head = HeadModel(_part_of(arrays, self.kept), torch.float64)
        layout = self.head.layout
        names = ["jaw", "left_eye", "right_eye"] + ["eyelids"] * ("eyelids" in layout)
        self._free = torch.cat([torch.arange(layout.size)[layout.slice(name)] for name in names])

    def start(self, expression: Float[np.ndarray, "_"]) -> Float[Tensor, "H"]:
        """Theta with this expression, the rest at rest."""
        return self.head.layout.join({"expression": torch.from_numpy(expression)})

    def shape(
        self, theta: Float[Tensor, "N H"], targets: Float[Tensor, "N V 3"]
    ) -> Float[Tensor, "I"]:
        """The identity of several frames, whose poses are found with it."""
        identity = torch.zeros(self.head.num_identity, dtype=torch.float64)
        count, frames = len(identity), range(len(theta))
        for _ in range(_ITERATIONS):
            blocks, residuals = [], []
            for k in frames:
                at = self.head(theta[k], identity)
                # With a pose held, vertices are linear in the identity.
                of_shape = self.head(
                    theta[k].expand(count, -1), identity + torch.eye(count, dtype=torch.float64)
                )
                of_pose = self._derivatives(theta[k], identity)
                own = torch.zeros(len(frames), *of_pose.shape, dtype=torch.float64)
                own[k] = of_pose
                blocks.append(torch.cat([of_shape - at, own.flatten(0, 1)]).flatten(1).T)
                residuals.append((targets[k] - at).flatten())
            step = _solve(torch.cat(blocks), torch.cat(residuals))
            identity = identity + step[:count]
            theta = theta.clone()
            theta[:, self._free] += step[count:].unflatten(0, (len(frames), -1))
            if float(step.abs().max()) < _CONVERGED:
                break
        return identity

    def pose(
        self, theta: Float[Tensor, "H"], identity: Float[Tensor, "I"], target: Float[Tensor, "V 3"]
    ) -> tuple[Float[Tensor, "H"], float]:
        """Theta whose vertices are the target's, and the largest distance left in metres."""
        residual = target - self.head(theta, identity)
        for _ in range(_ITERATIONS):
            derivatives = self._derivatives(theta, identity)
            step = _solve(derivatives.flatten(1).T, residual.flatten())
            theta = theta.clone()
            theta[self._free] += step
            residual = target - self.head(theta, identity)
            if float(step.abs().max()) < _CONVERGED:
                break
        return theta, float(residual.norm(dim=-1).max())

    def _derivatives(
        self, theta: Float[Tensor, "H"], identity: Float[Tensor, "I"]
    ) -> Float[Tensor, "P V 3"]:
        """Of the vertices by each free parameter, by central differences."""
        steps = torch.zeros(len(self._free), len(theta), dtype=torch.float64)
        steps[range(len(self._free)), self._free] = _STEP
        ahead, behind = (self.head(theta + sign * steps, identity) for sign in (1, -1))
        return (ahead - behind) / (2 * _STEP)


def _part_of(arrays: HeadArrays, kept: Int[np.ndarray, "K"]) -> HeadArrays:
    """A head of these vertices alone; all that joints depend on must be among them."""
    none, eyelids = np.zeros((0, 3), np.int64), arrays.eyelid_dirs
    return replace(
        arrays,
        v_template=arrays.v_template[kept],
        shapedirs=arrays.shapedirs[kept],
        posedirs=arrays.posedirs[kept],
        joint_regressor=arrays.joint_regressor[:, kept],
        skinning_weights=arrays.skinning_weights[kept],
        faces=none,
        uv_faces=none,
        eyelid_dirs=None if eyelids is None else eyelids[kept],
        vertex_groups={},
    )


def _solve(derivatives: Float[Tensor, "R P"], residual: Float[Tensor, "R"]) -> Float[Tensor, "P"]:
    """Least squares; what no vertex tells stays where it is."""
    normal = derivatives.T @ derivatives
    normal += _DAMPING * normal.diagonal().mean() * torch.eye(len(normal), dtype=normal.dtype)
    return torch.linalg.solve(normal, derivatives.T @ residual)
