"""Where the middles of the irises lie on a head's mesh."""

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays

_RIGHT_LEFT = (4, 3)
"""The eyes' joints, in the order of FaceMesh's irises."""
_ON_EDGE = 1e-6
"""An axis that meets a vertex or an edge is outside of every triangle by rounding alone."""


def iris_places(arrays: HeadArrays) -> tuple[Int[np.ndarray, "2 3"], Float[np.ndarray, "2 3"]]:
    """Triangles' vertices and barycentric places of the right iris and of the left one.

    Straight ahead of each eye's joint on the eyeball of the head at rest. As points of the mesh
    they go where the identity takes them, which may turn an eyeball by some degrees. Raises
    UserError for a head without eyeballs there.
    """
    template = arrays.v_template.astype(np.float64)
    joints = arrays.joint_regressor.astype(np.float64) @ template
    corners, places = [], []
    for joint in _RIGHT_LEFT:
        eyeball = (arrays.skinning_weights[:, joint] > 0.5)[arrays.faces].all(1)
        faces = arrays.faces[eyeball].astype(np.int64)
        a, b, c = (template[faces] - joints[joint]).transpose(1, 0, 2)
        # Signed areas of the triangle's parts around the axis, as seen along it.
        parts = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], -1)
        shares = parts / np.where(parts.sum(1) == 0, np.inf, parts.sum(1))[:, None]
        ahead = (shares.min(1) > -_ON_EDGE) & (shares.max(1) > _ON_EDGE) & ((a + b + c)[:, 2] > 0)
        if not ahead.any():
            raise UserError(
                f"The head model '{arrays.name}' has no eyeball before its eyes' joints.",
                "Name a FLAME model or a head in its axes (metres, y up, the face towards +z).",
            )
        # The foremost, where there is a cornea before the iris.
        nearest = int(np.argmax(np.where(ahead, (a + b + c)[:, 2], -np.inf)))
        corners.append(faces[nearest])
        places.append(shares[nearest])
    return np.array(corners), np.array(places)


def _cross(first: Float[np.ndarray, "T 3"], second: Float[np.ndarray, "T 3"]) -> np.ndarray:
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
