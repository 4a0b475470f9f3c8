"""The embedded head as another model: other triangles, person, size, tilt and expressions."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rgbavatar_ns.head import HeadArrays

TURN = Rotation.from_rotvec([0.08, 0.0, 0.0]).as_matrix()
SCALE, SHIFT_M = 1.05, np.array([0.0, 0.02, -0.01])


def remeshed(seed: int = 0) -> HeadArrays:
    """Four triangles for each, cut at places that slide over the old ones, vertices shuffled.

    The surface is the same, so that its landmarks are known.
    """
    head, random = HeadArrays.embedded(), np.random.default_rng(seed)
    faces, vertices = head.faces, len(head.v_template)
    edges, row, uses = np.unique(
        np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1),
        axis=0,
        return_inverse=True,
        return_counts=True,
    )
    middles = vertices + row.reshape(-1, 3)
    count = vertices + len(edges)
    triangle, place = np.zeros(count, np.int64), np.zeros((count, 3))
    for corner in range(3):
        for row, ends in ((faces[:, corner], [corner]), (middles[:, corner], [corner, corner - 2])):
            triangle[row] = np.arange(len(faces))
            place[row] = 0.0
            place[row[:, None], ends] = 1 / len(ends)
    inner = vertices + np.flatnonzero(uses == 2)
    slide = random.uniform(0, 0.3, (len(inner), 1))
    place[inner] = (1 - slide) * place[inner] + slide / 3
    (a, b, c), (ab, bc, ca) = faces.T, middles.T
    cut = np.concatenate(
        [np.stack(part, 1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    order = random.permutation(count)
    number = np.argsort(order)
    triangle, place = triangle[order], place[order]

    def at(values: np.ndarray, corners: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nk...->n...", place, values[corners[triangle]]).astype(np.float32)

    regressor = np.zeros((5, count), np.float32)
    regressor[:, number[:vertices]] = head.joint_regressor
    return replace(
        head,
        name="remeshed",
        v_template=at(head.v_template, faces),
        shapedirs=at(head.shapedirs, faces),
        posedirs=at(head.posedirs, faces),
        joint_regressor=regressor,
        skinning_weights=at(head.skinning_weights, faces),
        faces=number[cut],
        uv=at(head.uv, head.uv_faces),
        uv_faces=number[cut],
        vertex_groups={
            name: np.flatnonzero(np.isin(faces[triangle], group).all(1))
            for name, group in head.vertex_groups.items()
        },
    )


def as_another_model(head: HeadArrays, person: np.ndarray, mix: np.ndarray) -> HeadArrays:
    """The same with this person at rest, tilted and grown; numbered expressions, mixed by `mix`."""
    template = head.v_template + head.shapedirs[..., : head.num_identity] @ person
    identity, expression = np.split(head.shapedirs, [head.num_identity], axis=2)
    directions = np.concatenate([identity, expression @ mix], axis=2)
    return replace(
        head,
        name="another model",
        v_template=moved(template).astype(np.float32),
        shapedirs=(SCALE * np.einsum("xy,vyc->vxc", TURN, directions)).astype(np.float32),
        expression_names=tuple(f"expression_{number}" for number in range(mix.shape[1])),
    )


def moved(points: np.ndarray) -> np.ndarray:
    """From the embedded head's space to that of `as_another_model`."""
    return SCALE * points @ TURN.T + SHIFT_M
