"""How well the fitted head's outline agrees with the matte."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

# The part of the face whose outline is skin: from a little above the chin to the eyes, as shares
# of the height from chin to forehead; and how far beside the head the matte is looked at.
_FACE_FROM, _FACE_TO, _BESIDE = 0.1, 0.6, 0.2


@dataclass(frozen=True)
class SilhouetteAgreement:
    """Two shares between 0 and 1; None where the head is outside of the picture.

    `coverage`: how much of the mesh's silhouette above the chin the matte holds. Hair stands off
    the mesh, which has none, so what the matte holds beyond is not counted against it.
    `face_iou`: intersection over union of silhouette and matte between chin and eyes, up to a
    fifth of the face's height beside the mesh: there the outline is skin, unless hair hangs down
    beside the cheeks, which lowers it.
    """

    coverage: float | None
    face_iou: float | None

    def to_json(self) -> dict[str, Any]:
        """By name."""
        return asdict(self)


def silhouette_agreement(
    silhouette: Float[np.ndarray, "S S"],
    alpha: Float[np.ndarray, "S S"],
    inside: Float[np.ndarray, "S S"],
    above_chin: Float[np.ndarray, "S S"],
    face_height_px: float,
) -> SilhouetteAgreement:
    """Compare a mesh's silhouette with a matte; `inside` is 1 where the picture is.

    `above_chin` is 0 at the chin and 1 at the forehead.
    """
    mesh, matte, seen = silhouette > 0.5, alpha > 0.5, inside > 0.5
    head = mesh & seen & (above_chin > 0)
    face = seen & (above_chin > _FACE_FROM) & (above_chin < _FACE_TO)
    columns = np.flatnonzero((mesh & face).any(0))
    if columns.size:
        beside = round(_BESIDE * face_height_px)
        face[:, : max(0, columns[0] - beside)] = False
        face[:, columns[-1] + 1 + beside :] = False
    return SilhouetteAgreement(
        _share(head & matte, head), _share(mesh & matte & face, (mesh | matte) & face)
    )


def _share(part: np.ndarray, whole: np.ndarray) -> float | None:
    count = int(np.count_nonzero(whole))
    return np.count_nonzero(part) / count if count else None
