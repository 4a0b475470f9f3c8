"""A small random head of FLAME's shape: 300 + 100 directions, correctives, eyelids, a UV grid."""

import numpy as np

from rgbavatar_ns.head import HeadArrays


def grid_faces(side: int) -> np.ndarray:
    """Two triangles for each square of a grid of side x side vertices, row by row."""
    row, column = np.divmod(np.arange((side - 1) ** 2), side - 1)
    corner = row * side + column
    lower = np.stack([corner, corner + 1, corner + side + 1], 1)
    upper = np.stack([corner, corner + side + 1, corner + side], 1)
    return np.concatenate([lower, upper])


def flame_shaped_arrays(seed: int = 0, num_vertices: int = 36) -> HeadArrays:
    side = int(num_vertices**0.5)
    assert side * side == num_vertices
    generator = np.random.default_rng(seed)
    regressor = generator.uniform(0, 1, (5, num_vertices))
    weights = generator.uniform(0, 1, (num_vertices, 5))
    faces = grid_faces(side)
    # FLAME's UV map has triangles without area: the last one gets two equal corners.
    uv_faces = faces.copy()
    uv_faces[-1, 2] = uv_faces[-1, 1]
    v, u = np.divmod(np.arange(num_vertices), side)
    return HeadArrays(
        name="synthetic",
        v_template=generator.normal(0, 0.1, (num_vertices, 3)),
        shapedirs=generator.normal(0, 0.01, (num_vertices, 3, 400)),
        num_identity=300,
        posedirs=generator.normal(0, 0.01, (num_vertices, 3, 36)),
        joint_regressor=regressor / regressor.sum(1, keepdims=True),
        parents=np.array([-1, 0, 1, 1, 1]),
        skinning_weights=weights / weights.sum(1, keepdims=True),
        faces=faces,
        uv=np.stack([u, v], 1) / (side - 1),
        uv_faces=uv_faces,
        expression_names=tuple(f"expression_{i}" for i in range(100)),
        eyelid_dirs=generator.normal(0, 0.01, (num_vertices, 3, 2)),
        vertex_groups={"skin": np.arange(num_vertices)},
    )
