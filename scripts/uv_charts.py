"""Flatten disc-shaped charts into rectangles of the UV square, without a flipped triangle.

Tutte's embedding gives a valid start; then the symmetric Dirichlet energy against each triangle's
own shape, scaled by the wanted texel density, is lowered as in "Scalable Locally Injective
Mappings" (Rabinovich et al. 2017). Border vertices slide along their side. No step flips a
triangle and the border stays a rectangle, so the result is one to one.
"""

from collections import Counter

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu


def boundary_loops(faces: np.ndarray) -> list[list[int]]:
    """Border loops in the orientation of the faces, longest first; closed meshes have none."""
    edges = Counter()
    for face in faces.tolist():
        for start, end in zip(face, face[1:] + face[:1]):
            edges[start, end] += 1
    following = {start: end for start, end in edges if (end, start) not in edges}
    loops = []
    while following:
        start = min(following)
        loop = [start]
        vertex = following.pop(start)
        while vertex != start:
            loop.append(vertex)
            vertex = following.pop(vertex)
        loops.append(loop)
    return sorted(loops, key=len, reverse=True)


def _rest_frames(points: np.ndarray, faces: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Each triangle laid flat, times its scale: edge matrices [F, 2, 2] with edges as columns."""
    first = points[faces[:, 1]] - points[faces[:, 0]]
    second = points[faces[:, 2]] - points[faces[:, 0]]
    length = np.linalg.norm(first, axis=1)
    along = (first * second).sum(1) / length
    height = np.linalg.norm(np.cross(first, second), axis=1) / length
    zeros = np.zeros_like(length)
    flat = np.stack([np.stack([length, along], 1), np.stack([zeros, height], 1)], 1)
    return flat * scale[:, None, None]


def _tutte(count: int, faces: np.ndarray, border: np.ndarray, border_uv: np.ndarray) -> np.ndarray:
    """Uniform-weight embedding with the border fixed on a convex shape [count, 2]."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    ones = np.ones(len(edges))
    adjacency = sparse.coo_matrix((ones, (edges[:, 0], edges[:, 1])), (count, count))
    adjacency = (adjacency + adjacency.T).tocsr()
    laplacian = sparse.diags(np.asarray(adjacency.sum(1)).ravel()) - adjacency
    inner = np.setdiff1d(np.arange(count), border)
    uv = np.zeros((count, 2))
    uv[border] = border_uv
    right = -(laplacian[inner][:, border] @ border_uv)
    uv[inner] = splu(laplacian[inner][:, inner].tocsc()).solve(right)
    return uv


def _corner_gradients(rest: np.ndarray) -> np.ndarray:
    """How a linear function's gradient comes from its corner values [F, 3, 2]."""
    inverse = np.linalg.inv(rest)
    return np.stack([-inverse[:, 0] - inverse[:, 1], inverse[:, 0], inverse[:, 1]], 1)


def _jacobians(uv: np.ndarray, faces: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    return np.einsum("fia,fib->fab", uv[faces], gradients)


def _energy(uv: np.ndarray, faces: np.ndarray, gradients: np.ndarray, weights: np.ndarray) -> float:
    """Symmetric Dirichlet energy; infinite where a triangle is flipped."""
    jacobian = _jacobians(uv, faces, gradients)
    det = np.linalg.det(jacobian)
    if det.min() <= 0:
        return np.inf
    return float((weights * (jacobian**2).sum((1, 2)) * (1 + 1 / det**2)).sum())


def _proxy_minimum(
    uv: np.ndarray, faces: np.ndarray, gradients: np.ndarray, weights: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """Minimum of the quadratic that has the energy's gradient here (Rabinovich et al. 2017)."""
    left, stretch, right = np.linalg.svd(_jacobians(uv, faces, gradients))
    rotation = left @ right
    curvature = (stretch + 1) * (stretch**2 + 1) / stretch**3
    metric = np.einsum("f,fak,fk,fbk->fab", weights, left, curvature, left)
    blocks = np.einsum("fic,fjc,fab->fiajb", gradients, gradients, metric)
    forces = np.einsum("fab,fbc,fic->fia", metric, rotation, gradients)
    unknown = 2 * faces[:, :, None] + np.arange(2)
    rows = np.broadcast_to(unknown[:, :, :, None, None], blocks.shape)
    columns = np.broadcast_to(unknown[:, None, None, :, :], blocks.shape)
    matrix = sparse.coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel()))).tocsc()
    force = np.bincount(unknown.ravel(), forces.ravel(), uv.size)
    flat = uv.ravel().copy()
    held = np.setdiff1d(np.arange(uv.size), free)
    pull = force[free] - matrix[free][:, held] @ flat[held]
    system = matrix[free][:, free]
    damping = 1e-6 * system.diagonal()
    flat[free] = splu((system + sparse.diags(damping)).tocsc()).solve(pull + damping * flat[free])
    return flat.reshape(uv.shape)


def _longest_unflipped(uv: np.ndarray, step: np.ndarray, faces: np.ndarray) -> float:
    """The largest multiple of a step before the first triangle loses its area."""
    start, move = uv[faces], step[faces]
    e, g = start[:, 1] - start[:, 0], start[:, 2] - start[:, 0]
    de, dg = move[:, 1] - move[:, 0], move[:, 2] - move[:, 0]

    def cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]

    a, b, c = cross(de, dg), cross(e, dg) + cross(de, g), cross(e, g)
    root = np.sqrt(np.maximum(b * b - 4 * a * c, 0))
    half = -0.5 * (b + np.where(b >= 0, root, -root))
    with np.errstate(divide="ignore", invalid="ignore"):
        lengths = np.concatenate([half / a, c / half])
    real = np.tile(b * b - 4 * a * c >= 0, 2)
    lengths = lengths[real & np.isfinite(lengths) & (lengths > 0)]
    return float(lengths.min(initial=np.inf))


def _minimise(
    uv: np.ndarray, faces: np.ndarray, rest: np.ndarray, held: np.ndarray, steps: int
) -> np.ndarray:
    """Lower the energy by steps towards the proxy's minimum; no step flips a triangle."""
    gradients, weights = _corner_gradients(rest), np.linalg.det(rest) / 2
    weights = weights / weights.sum()
    free = np.flatnonzero(~held.ravel())
    value = _energy(uv, faces, gradients, weights)
    for _ in range(steps):
        step = _proxy_minimum(uv, faces, gradients, weights, free) - uv
        length = min(1.0, 0.8 * _longest_unflipped(uv, step, faces))
        new_value = _energy(uv + length * step, faces, gradients, weights)
        while new_value > value and length > 1e-9:
            length /= 2
            new_value = _energy(uv + length * step, faces, gradients, weights)
        if not value - new_value > 1e-5 * value:
            break
        uv, value = uv + length * step, new_value
    return uv


def _rectangle_border(
    points: np.ndarray, loop: list[int], corners: list[int], size: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the loop on the rectangle by arc length, and which coordinates are held."""
    width, height = size
    places = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], float)
    starts = [loop.index(corner) for corner in corners]
    ordered = loop[starts[0] :] + loop[: starts[0]]
    starts = [ordered.index(corner) for corner in corners] + [len(ordered)]
    if sorted(starts) != starts:
        raise ValueError("corners must be given in the loop's order")
    closed = [*ordered, ordered[0]]
    uv, held = {}, {}
    for side in range(4):
        run = closed[starts[side] : starts[side + 1] + 1]
        lengths = np.linalg.norm(np.diff(points[run], axis=0), axis=1)
        fractions = np.concatenate([[0], np.cumsum(lengths) / lengths.sum()])
        for vertex, fraction in list(zip(run, fractions))[:-1]:
            uv[vertex] = places[side] + fraction * (places[side + 1] - places[side])
            held[vertex] = [side % 2 == 1, side % 2 == 0]
        held[run[0]] = [True, True]
    return np.array([uv[v] for v in loop]), np.array([held[v] for v in loop])


def flatten_to_rectangle(
    points: np.ndarray,
    faces: np.ndarray,
    corners: list[int],
    size: tuple[float, float],
    density: np.ndarray,
    steps: int = 60,
) -> np.ndarray:
    """UV [V, 2] of a disc (holes allowed) whose border becomes the rectangle of this size.

    `corners` are four border vertices, anticlockwise from the lower left; `density` [F] is the
    wanted relative number of texels per area of each triangle.
    """
    outer, *holes = boundary_loops(faces)
    count = len(points)
    filled, all_points = [faces], [points]
    fan_faces = 0
    for hole in holes:
        centre = count + len(all_points) - 1
        fan = [[end, start, centre] for start, end in zip(hole, hole[1:] + hole[:1])]
        filled.append(np.array(fan))
        all_points.append(points[hole].mean(0, keepdims=True))
        fan_faces += len(fan)
    solid_faces, solid_points = np.concatenate(filled), np.concatenate(all_points)
    border_uv, held = _rectangle_border(points, outer, corners, size)
    uv = _tutte(len(solid_points), solid_faces, np.array(outer), border_uv)
    fixed = np.zeros_like(uv, bool)
    fixed[outer] = held

    rest = _rest_frames(points, faces, np.sqrt(density))
    area = np.linalg.det(rest) / 2
    rest *= np.sqrt(size[0] * size[1] * 0.99 / area.sum())
    if fan_faces:
        # A hole's filling only has to stay unflipped: a small shape has a small weight.
        side = np.sqrt(np.median(np.linalg.det(rest))) * 0.3
        shape = np.array([[1, 0.5], [0, 0.75**0.5]]) * side
        rest = np.concatenate([rest, np.repeat(shape[None], fan_faces, 0)])
    return _minimise(uv, solid_faces, rest, fixed, steps)[:count]


def flatten_freely(
    points: np.ndarray, faces: np.ndarray, upright: np.ndarray, steps: int = 300
) -> np.ndarray:
    """UV [V, 2] of a disc whose border goes where it will, true to the disc's size; turned like
    `upright` [V, 2].
    """
    (loop,) = boundary_loops(faces)
    lengths = np.linalg.norm(points[loop] - points[np.roll(loop, 1)], axis=1)
    angle = 2 * np.pi * np.cumsum(lengths) / lengths.sum()
    rest = _rest_frames(points, faces, np.ones(len(faces)))
    radius = np.sqrt(np.linalg.det(rest).sum() / 2 / np.pi)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    held = np.zeros((len(points), 2), bool)
    held[loop[0]] = True
    uv = _tutte(len(points), faces, np.array(loop), circle)
    flat = _minimise(uv, faces, rest, held, steps)
    # Back to how `upright` stands (Procrustes; both have the same orientation).
    a, b = (part - part.mean(0) for part in (flat, upright))
    left, _, right = np.linalg.svd(a.T @ b)
    return a @ (left @ right)
