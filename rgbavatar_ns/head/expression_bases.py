"""Expressions of one nameless basis in another's: FLAME's versions share a mesh, not directions."""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.head.arrays import HeadArrays

DIRECTION_PRIOR_M = 0.006
"""A unit of a direction costs as much as this much motion left over on a single one of the face's
points: FLAME's later directions are weak, and tens of units of them would wrinkle a person."""
_SAME = 0.01
"""Share of their size by which equal directions may differ: files keep them in 16 bits, too."""
_NAMELESS = re.compile(r"expression_\d+")


@dataclass(frozen=True)
class ExpressionFit:
    """The way from one basis to another: `expression @ table`."""

    table: Float[np.ndarray, "G H"]
    left_over: float
    """The share of the first basis's motion, by size, that the other one cannot follow."""


def expression_fit(driver: HeadArrays, avatar: HeadArrays) -> ExpressionFit | None:
    """The driver's expressions in the avatar's directions; None where numbers say the same there.

    So they do where they have names, and where a mesh's directions are the same ones, as many as
    both have; between different meshes nothing is known of them. Vertices that one of both has
    beyond the other's, such as teeth, count for nothing. Least squares with the prior of ARKit's
    table (`arkit_fit`). Source: ours.
    """
    if not all(map(_is_nameless, (driver, avatar))) or not _share_a_mesh(driver, avatar):
        return None
    vertices = min(len(driver.v_template), len(avatar.v_template))
    theirs, ours = (
        one.shapedirs[:vertices, :, one.num_identity :].astype(np.float64).reshape(3 * vertices, -1)
        for one in (driver, avatar)
    )
    both = min(theirs.shape[1], ours.shape[1])
    differ = np.linalg.norm(theirs[:, :both] - ours[:, :both])
    if differ <= _SAME * np.linalg.norm(ours[:, :both]):
        return None
    prior = DIRECTION_PRIOR_M**2 * np.eye(ours.shape[1])
    table = np.linalg.solve(ours.T @ ours + prior, ours.T @ theirs)
    size = np.linalg.norm(theirs)
    left_over = np.linalg.norm(theirs - ours @ table) / size if size > 0 else 0.0
    return ExpressionFit(table.T, float(left_over))


def _is_nameless(arrays: HeadArrays) -> bool:
    names = arrays.expression_names
    return bool(names) and all(_NAMELESS.fullmatch(name) for name in names)


def _share_a_mesh(one: HeadArrays, other: HeadArrays) -> bool:
    """Whether the triangles of both are the same, up to those that one of them has beyond."""
    count = min(len(one.faces), len(other.faces))
    return bool(np.array_equal(one.faces[:count], other.faces[:count]))
