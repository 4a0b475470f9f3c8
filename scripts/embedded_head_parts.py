"""Cut MakeHuman's head out of the body, round its eyeballs, and give it FLAME's five joints."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from makehuman_source import BaseMesh

PARTS = ("skin", "left_eye", "right_eye", "upper_teeth", "lower_teeth", "tongue")
SOURCE_GROUPS = {
    "body": "skin",
    "helper-l-eye": "left_eye",
    "helper-r-eye": "right_eye",
    "helper-upper-teeth": "upper_teeth",
    "helper-lower-teeth": "lower_teeth",
    "helper-tongue": "tongue",
}
HEAD_BONES = (
    "head",
    "neck",
    "jaw",
    "eye.",
    "tongue",
    "levator",
    "oculi",
    "orbicularis",
    "oris",
    "risorius",
    "temporalis",
    "special",
)
CUT_WEIGHT = 0.05
JOINT_VERTICES = 80
"""From how many vertices at most a joint is regressed."""


@dataclass(frozen=True)
class HeadMesh:
    """The head in triangles; each vertex is a weighted mean of MakeHuman's vertices.

    `source` [V, S] carries offsets over; `face_parts` names each triangle's part; MakeHuman's own
    texture coordinates (`guide_uv`, `guide_faces`) orient ours.
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_parts: np.ndarray
    source: sparse.csr_matrix
    guide_uv: np.ndarray
    guide_faces: np.ndarray

    @property
    def groups(self) -> dict[str, np.ndarray]:
        """Vertices of each part."""
        return {part: np.unique(self.faces[self.face_parts == part]) for part in PARTS}

    def gather(self, offsets: np.ndarray) -> np.ndarray:
        """Whole-body per-vertex values [S, ...] on the head's vertices."""
        return self.source @ offsets

    def moved(self, offset: np.ndarray) -> "HeadMesh":
        """The same mesh elsewhere."""
        return replace(self, vertices=self.vertices + offset)

    def eye_centre(self, part: str) -> np.ndarray:
        """Centre of the sphere through an eyeball's vertices."""
        return fit_sphere(self.vertices[self.groups[part]])[0]

    def joints(self, base: BaseMesh, adult: np.ndarray, jaw_pivot: np.ndarray) -> np.ndarray:
        """Root, neck, jaw, left eye, right eye [5, 3]."""
        moved = self.vertices[0] - (self.source[0] @ adult)[0]
        root = adult[np.unique(base.quads[base.groups == "joint-neck"])].mean(0) + moved
        # The neck turns and nods about MakeHuman's third neck bone, between its two end points.
        neck = adult[[226, 17824]].mean(0) + moved
        eyes = [self.eye_centre("left_eye"), self.eye_centre("right_eye")]
        joints = np.stack([root, neck, jaw_pivot, *eyes])
        joints[:3, 0] = 0
        return joints


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the sphere through points, least squares."""
    system = np.concatenate([2 * points, np.ones((len(points), 1))], 1)
    solution = np.linalg.lstsq(system, (points**2).sum(1), rcond=None)[0]
    return solution[:3], float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))


def _triangulate(points: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Which diagonal each quad is cut along: corner orders [Q, 2, 3], the shorter one wins."""
    corners = points[quads]
    first = np.linalg.norm(corners[:, 2] - corners[:, 0], axis=1)
    second = np.linalg.norm(corners[:, 3] - corners[:, 1], axis=1)
    along_first = np.array([[0, 1, 2], [0, 2, 3]])
    along_second = np.array([[0, 1, 3], [1, 2, 3]])
    return np.where((first <= second + 1e-7)[:, None, None], along_first, along_second)


def _compact(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Used indices in order, and the array renumbered over them."""
    used, renumbered = np.unique(index, return_inverse=True)
    return used, renumbered.reshape(index.shape)


def cut_head(base: BaseMesh, adult: np.ndarray, bones: dict[str, np.ndarray]) -> HeadMesh:
    """Quads whose corners all follow head, neck, jaw, eye, tongue or face bones, as triangles."""
    total = sum(weights for bone, weights in bones.items() if bone.startswith(HEAD_BONES))
    wanted = np.isin(base.groups, list(SOURCE_GROUPS))
    keep = wanted & (np.asarray(total)[base.quads] > CUT_WEIGHT).all(1)
    quads, texture_quads = base.quads[keep], base.texture_quads[keep]
    order = _triangulate(adult, quads).reshape(len(quads), 6)
    triangles = np.take_along_axis(quads, order, 1).reshape(-1, 3)
    texture_triangles = np.take_along_axis(texture_quads, order, 1).reshape(-1, 3)
    used, faces = _compact(triangles)
    used_uv, guide_faces = _compact(texture_triangles)
    ones = np.ones(len(used))
    source = sparse.csr_matrix((ones, (np.arange(len(used)), used)), (len(used), len(adult)))
    parts = np.array([SOURCE_GROUPS[name] for name in np.repeat(base.groups[keep], 2)])
    guide_uv = base.texture_vertices[used_uv]
    return HeadMesh(adult[used], faces, parts, source, guide_uv, guide_faces)


def _split_edges(
    faces: np.ndarray, wanted: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Each wanted triangle in four: new faces of those, and the ends [E, 2] of each new vertex."""
    chosen = faces[wanted]
    edges = np.sort(np.stack([chosen, np.roll(chosen, -1, 1)], 2).reshape(-1, 2), 1)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = (count + middle.reshape(-1, 3)).T
    p, q, r = chosen.T
    quarters = [[p, a, c], [a, q, b], [c, b, r], [a, b, c]]
    split = np.stack([np.stack(quarter, 1) for quarter in quarters], 1).reshape(-1, 3)
    return split, ends


def round_eyeballs(mesh: HeadMesh) -> HeadMesh:
    """Split the eyeballs' triangles once and put the new vertices on the sphere.

    MakeHuman's helper eyeballs have eight meridians; lids would cut into such a coarse ball.
    """
    is_eye = np.isin(mesh.face_parts, ["left_eye", "right_eye"])
    split, ends = _split_edges(mesh.faces, is_eye, len(mesh.vertices))
    guide_split, guide_ends = _split_edges(mesh.guide_faces, is_eye, len(mesh.guide_uv))
    halves = mesh.source[ends[:, 0]] / 2 + mesh.source[ends[:, 1]] / 2
    added = mesh.vertices[ends].mean(1)
    vertices = np.concatenate([mesh.vertices, added])
    for side in (1, -1):
        eye = np.unique(mesh.faces[is_eye])
        eye = eye[mesh.vertices[eye, 0] * side > 0]
        centre, radius = fit_sphere(mesh.vertices[eye])
        new = len(mesh.vertices) + np.flatnonzero(added[:, 0] * side > 0)
        for index in (eye, new):
            ray = vertices[index] - centre
            vertices[index] = centre + ray * (radius / np.linalg.norm(ray, axis=1, keepdims=True))
    guide_added = mesh.guide_uv[guide_ends].mean(1)
    return HeadMesh(
        vertices,
        np.concatenate([mesh.faces[~is_eye], split]),
        np.concatenate([mesh.face_parts[~is_eye], np.repeat(mesh.face_parts[is_eye], 4)]),
        sparse.csr_matrix(sparse.vstack([mesh.source, halves])),
        np.concatenate([mesh.guide_uv, guide_added]),
        np.concatenate([mesh.guide_faces[~is_eye], guide_split]),
    )


@dataclass(frozen=True)
class Hinge:
    """The rotation about x that the sculpted open jaw makes."""

    angle: float
    pivot: np.ndarray

    def offsets(self, points: np.ndarray) -> np.ndarray:
        """How the full opening moves points that follow the jaw wholly."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        return (points - self.pivot) @ (turn - np.eye(3)).T


def jaw_hinge(mesh: HeadMesh, jaw_open: np.ndarray) -> Hinge:
    """Fit the hinge to the lower teeth, which are rigid."""
    teeth = mesh.groups["lower_teeth"]
    before = mesh.vertices[teeth][:, 1:]
    after = before + jaw_open[teeth][:, 1:]
    a, b = before - before.mean(0), after - after.mean(0)
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    pivot = np.linalg.solve(np.eye(2) - turn, after.mean(0) - turn @ before.mean(0))
    return Hinge(float(angle), np.array([0, *pivot]))


def skinning_weights(
    mesh: HeadMesh, bones: dict[str, np.ndarray], hinge: Hinge, jaw_open: np.ndarray
) -> np.ndarray:
    """Weights [V, 5] of root, neck, jaw, left eye, right eye; rows sum to one."""
    follow = {"neck01": 0.1, "neck02": 0.45, "neck03": 0.85}
    head = np.zeros(len(next(iter(bones.values()))))
    for bone, values in bones.items():
        if bone.startswith(HEAD_BONES):
            head += follow.get(bone, 1.0) * values
    total = np.asarray(sum(bones.values()))
    head = mesh.gather(head / np.maximum(total, 1e-9)).clip(0, 1)
    groups = mesh.groups
    for part in PARTS[1:]:
        head[groups[part]] = 1
    # How far along the hinge's motion each vertex goes when the jaw is opened by the sculptor;
    # the constant keeps vertices at the axis, which hardly move, from taking any value.
    motion = hinge.offsets(mesh.vertices)
    jaw = (motion * jaw_open).sum(1) / ((motion**2).sum(1) + 0.002**2)
    jaw = jaw.clip(0, 1)
    for part in ("left_eye", "right_eye", "upper_teeth"):
        jaw[groups[part]] = 0
    for part in ("lower_teeth", "tongue"):
        jaw[groups[part]] = 1
    weights = np.stack([1 - head, head * (1 - jaw), head * jaw, 0 * jaw, 0 * jaw], 1)
    for column, part in ((3, "left_eye"), (4, "right_eye")):
        weights[groups[part]] = np.eye(5)[column]
    weights[weights < 2e-3] = 0
    return weights / weights.sum(1, keepdims=True)


def regress_joint(
    mesh: HeadMesh, joint: np.ndarray, motion_m: np.ndarray, index: int
) -> np.ndarray:
    """Non-negative weights [V] that sum to one and reproduce a joint of the neutral head.

    An eye comes from its own eyeball; the others from the skin around them, the less from a
    vertex the more any expression moves it (`motion_m` [V]), so that joints hardly shift.
    """
    weights = np.zeros(len(mesh.vertices))
    groups = mesh.groups
    chosen = groups[("left_eye", "right_eye")[index - 3] if index >= 3 else "skin"]
    points = mesh.vertices[chosen] - joint
    distance = np.linalg.norm(points, axis=1)
    reluctance = np.ones(len(chosen))
    if index < 3:
        reluctance = 1 + (motion_m[chosen] / 5e-4) ** 2 + (distance / distance.min()) ** 2
    # Smallest weighted sum of squares under the constraints; what comes out negative or
    # least is dropped, so that each joint needs few vertices.
    moments = np.concatenate([points.T, np.ones((1, len(chosen)))])
    active = np.arange(len(chosen))
    while True:
        scaled = moments[:, active] / reluctance[active]
        solution = scaled.T @ np.linalg.solve(scaled @ moments[:, active].T, [0, 0, 0, 1])
        if solution.min() >= 0 and len(active) <= JOINT_VERTICES:
            break
        # A few at a time, so that the remaining ones can take over.
        keep = max(JOINT_VERTICES, int(0.8 * len(active)))
        floor = max(np.sort(solution)[-keep], 1e-12) if len(active) > keep else 1e-12
        active = active[solution >= floor]
    weights[chosen[active]] = solution
    return weights
