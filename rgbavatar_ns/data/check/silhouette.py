"""How well a head's outline agrees with a matte: what `track` and `check` both go by."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class SilhouetteOverlap:
    """Pixels of a mesh and a matte: on both, on either, on the mesh."""

    both: int
    either: int
    mesh: int

    @property
    def iou(self) -> float:
        """Intersection over union; 0 where there is neither."""
        return self.both / max(self.either, 1)

    @property
    def covered(self) -> float:
        """Share of the mesh that lies on the matte. Hair, which no mesh has, does not lower it."""
        return self.both / max(self.mesh, 1)


def silhouette_overlap(
    silhouette: Float[np.ndarray, "h w"],
    alpha: Float[np.ndarray, "h w"],
    region: Bool[np.ndarray, "h w"],
) -> SilhouetteOverlap:
    """Compare a mesh's silhouette with a matte, both cut at a half, where `region` is True."""
    mesh, matte = (silhouette > 0.5) & region, (alpha > 0.5) & region
    return SilhouetteOverlap(*(int(part.sum()) for part in (mesh & matte, mesh | matte, mesh)))


def down_to_the_neck(silhouette: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The rows down to the silhouette's lowest one: below it are shoulders, which no mesh has."""
    rows = np.flatnonzero((silhouette > 0.5).any(1))
    return np.repeat(
        np.arange(len(silhouette))[:, None] <= rows.max(initial=-1), silhouette.shape[1], 1
    )
