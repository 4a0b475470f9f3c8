"""Add neck's foot, shoulders, chest and upper arms to the embedded head, and lay out their texture.

The head's own vertices and triangles come first and stay as they are, so that whatever is known of
places on the head (landmarks, how they respond) holds for the bust too.
"""

import numpy as np
import scipy.sparse as sparse
from embedded_head_parts import CUT_WEIGHT, HEAD_BONES, HeadMesh
from makehuman_source import BaseMesh
from scipy.sparse.csgraph import connected_components
from uv_charts import boundary_loops, flatten_freely

LOWEST_M = 0.27
"""MakeHuman's height at which chest and arms are cut, above the ground of its own world: a hand
below the breastbone, lower than a portrait shows."""
SHOULDER_M = np.array([0.170, 0.502, 0.019])
LOWERED_DEGREES = 32.0
"""MakeHuman's arms stand 48 degrees below the horizontal; before a camera they hang."""
ARM_BONES = ("upperarm", "lowerarm", "wrist", "finger", "metacarpal")
TORSO_TOP, FRONT_WIDTH = 0.285, 0.66
"""Height of the torso's strip at the bottom of the UV square, above which the head's charts go, and
the front's share of its width: a film seldom shows the back."""
TORSO_MARGIN = 1.6 / 256


def lowered_arms(
    points: np.ndarray, bones: dict[str, np.ndarray], *, are_offsets: bool = False
) -> np.ndarray:
    """Whole-body points [V, 3] (or offsets of such) as both arms are let down beside the body."""
    total = np.maximum(np.asarray(sum(bones.values())), 1e-9)
    moved = points.copy()
    for side, ending in ((1, ".L"), (-1, ".R")):
        names = [n for n in bones if n.endswith(ending) and n.startswith(ARM_BONES)]
        share = np.asarray(sum(bones[name] for name in names)) / total
        angle = -side * np.radians(LOWERED_DEGREES) * share
        arm = points - (0.0 if are_offsets else SHOULDER_M * [side, 1, 1])
        c, s = np.cos(angle) - 1, np.sin(angle)
        moved[:, 0] += c * arm[:, 0] - s * arm[:, 1]
        moved[:, 1] += s * arm[:, 0] + c * arm[:, 1]
    return moved


def with_torso(
    head: HeadMesh, base: BaseMesh, lowered: np.ndarray, bones: dict[str, np.ndarray]
) -> HeadMesh:
    """The head's mesh with the body around its neck; `lowered` is the adult whose arms hang.

    The torso's triangles have the part "torso" and no texture of MakeHuman's to go by.
    """
    follows = np.asarray(sum(w for bone, w in bones.items() if bone.startswith(HEAD_BONES)))
    quads = base.quads[base.groups == "body"]
    is_head = (follows[quads] > CUT_WEIGHT).all(1)
    quads = quads[~is_head & (lowered[quads][..., 1] > LOWEST_M).all(1)]
    first, second = (np.linalg.norm(lowered[quads[:, k]] - lowered[quads[:, k + 2]], axis=1)
                     for k in (0, 1))  # fmt: skip
    order = np.where((first <= second)[:, None], [0, 1, 2, 0, 2, 3], [0, 1, 3, 1, 2, 3])
    triangles = np.take_along_axis(quads, order, 1).reshape(-1, 3)
    # Where the head's vertices, but for those that were split, come from.
    alone = np.flatnonzero(np.diff(head.source.indptr) == 1)
    place = dict(zip(head.source[alone].indices.tolist(), alone.tolist()))
    added = [v for v in np.unique(triangles).tolist() if v not in place]
    rim = next(v for v in np.unique(triangles).tolist() if v in place)
    shift = head.vertices[place[rim]] - lowered[rim]
    place |= {v: len(head.vertices) + k for k, v in enumerate(added)}
    faces = np.vectorize(place.__getitem__)(triangles)
    rows = sparse.csr_matrix(
        (np.ones(len(added)), (np.arange(len(added)), added)), (len(added), len(lowered))
    )
    return HeadMesh(
        np.concatenate([head.vertices, lowered[added] + shift]),
        np.concatenate([head.faces, faces]),
        np.concatenate([head.face_parts, np.full(len(faces), "torso")]),
        sparse.csr_matrix(sparse.vstack([head.source, rows])),
        head.guide_uv,
        np.concatenate([head.guide_faces, np.zeros_like(faces)]),
    )


def shoulder_directions(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """How shoulders and arms [V, 3, 2] go up, and apart, by 1; the neck and the breastbone stay."""
    x = np.abs(points[:, 0])
    outside = ((x - 0.05) / 0.08).clip(0, 1)
    share = weights[:, 0] * outside * outside * (3 - 2 * outside)
    none = np.zeros_like(share)
    up, apart = [none, share, none], [np.sign(points[:, 0]) * share, none, none]
    return np.stack([np.stack(up, 1), np.stack(apart, 1)], 2)


def torso_uv(mesh: HeadMesh) -> tuple[np.ndarray, np.ndarray]:
    """UV [VT, 2] of the torso's two charts, front and back, in its strip, and faces into it."""
    faces = mesh.faces[mesh.face_parts == "torso"]
    front = _front(mesh.vertices, faces)
    uv_faces, pieces, count = np.zeros_like(faces), [], 0
    for number, inside in enumerate((front, ~front)):
        used, local = np.unique(faces[inside], return_inverse=True)
        local = local.reshape(-1, 3)
        points = mesh.vertices[used]
        flat = flatten_freely(points, local, points[:, :2] * [1 - 2 * number, 1])
        low, high = flat.min(0), flat.max(0)
        left, right = ((0.0, FRONT_WIDTH), (FRONT_WIDTH, 1.0))[number]
        room = np.array([right - left, TORSO_TOP]) - 2 * TORSO_MARGIN
        # One scale for both directions, so that texels are squares on the body.
        scale = (room / (high - low)).min()
        corner = np.array([left, 0.0]) + TORSO_MARGIN
        pieces.append((flat - low) * scale + corner + 0.5 * (room - (high - low) * scale))
        uv_faces[inside] = local + count
        count += len(used)
    return np.concatenate(pieces), uv_faces


def _front(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which triangles [F] are the front's: a disc, as is what remains."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    front = np.cross(b - a, c - a)[:, 2] > 0
    neighbours = _neighbours(faces)
    while True:
        before = front.copy()
        for side in (True, False):
            inside = np.flatnonzero(front == side)
            _, label = connected_components(neighbours[inside][:, inside], directed=False)
            main = np.bincount(label).argmax()
            front[inside[label != main]] = not side
        # A triangle that hangs on its side by one edge gives it a ragged border.
        others = neighbours @ (front.astype(int) * 2 - 1)
        front = np.where(others * (front.astype(int) * 2 - 1) < 0, ~front, front)
        if (front == before).all():
            break
    for side in (front, ~front):
        if len(boundary_loops(faces[side])) != 1:
            raise ValueError("a half of the torso is no disc")
    return front


def _neighbours(faces: np.ndarray) -> sparse.csr_matrix:
    """1 where two triangles share an edge."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, 1)], 2).reshape(-1, 2), 1)
    _, edge = np.unique(edges, axis=0, return_inverse=True)
    on = sparse.csr_matrix(
        (np.ones(len(edge)), (np.repeat(np.arange(len(faces)), 3), edge.ravel()))
    )
    shared = sparse.csr_matrix(on @ on.T)
    shared.setdiag(0)
    shared.eliminate_zeros()
    return shared
