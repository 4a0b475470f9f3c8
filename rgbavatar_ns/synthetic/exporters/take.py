"""The demo subject as a performance of a FLAME-shaped head, to be written in any format."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import KDTree

from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.flame import EXPRESSIONS, FLAME_VERTICES, IDENTITIES, load_flame
from rgbavatar_ns.kernels.types import PinholeCameras
from rgbavatar_ns.synthetic import DemoConfig, DemoFilm, film_demo
from rgbavatar_ns.synthetic.flame import write_synthetic_flame

FLAME_FOLDER = "flame_model"
"""Beside the data: the synthetic pickle, to be named with --flame."""
_SAME = 1e-6


@dataclass(frozen=True)
class TakeFrame:
    """One frame: theta by field (float64), the camera (C = 1) and straight-alpha RGBA."""

    index: int
    theta: dict[str, Float[np.ndarray, "_"]]
    camera: PinholeCameras
    image_rgba: UInt8[np.ndarray, "height width 4"]

    @property
    def world_to_camera(self) -> Float[np.ndarray, "4 4"]:
        """The camera in OpenCV axes."""
        return self.camera.world_to_camera[0].double().numpy()

    @property
    def focal_px(self) -> Float[np.ndarray, "2"]:
        """Focal lengths of x and y."""
        return self.camera.focal_px[0].double().numpy()

    @property
    def principal_point_px(self) -> Float[np.ndarray, "2"]:
        """Where the optical axis meets the image."""
        return self.camera.principal_point_px[0].double().numpy()


@dataclass(frozen=True)
class Take:
    """What all frames share: FLAME's arrays without teeth, the person, and what is held out."""

    arrays: HeadArrays
    identity: Float[np.ndarray, "_"]
    num_frames: int
    num_test_frames: int
    width: int
    height: int
    name: str
    """Of the dataset's folder."""


class FlameFilm:
    """The demo subject filmed as FLAME of a version; writes the synthetic model into `dst`.

    The synthetic FLAME is the embedded head in other numbering, so that the same pictures belong
    to it; which of its expressions is which is found by comparing their directions.
    stiff_neck: see `film_demo`. Blinks are expressions here; a tracker's eyelids stay open.
    """

    def __init__(
        self, dst: Path, config: DemoConfig, version: str, stiff_neck: bool, name: str
    ) -> None:
        self.flame_path = write_synthetic_flame(dst / FLAME_FOLDER, version)
        self.film: DemoFilm = film_demo(config, stiff_neck)
        embedded = self.film.person.head.arrays
        arrays = load_flame(self.flame_path, teeth=False)
        own = self.film.person.identity.double().numpy()
        self._columns = _same_directions(embedded, arrays)
        self.take = Take(
            arrays,
            np.pad(own, (0, IDENTITIES - len(own))),
            config.num_frames,
            config.num_test_frames,
            config.image_size,
            config.image_size,
            name,
        )

    def frames(self) -> Iterator[TakeFrame]:
        """Render frame after frame."""
        layout = self.film.person.head.layout
        for frame in self.film.frames():
            parts = layout.split(frame.theta.double())
            theta = {name: part.numpy() for name, part in parts.items()}
            own = theta["expression"]
            theta["expression"] = np.zeros(EXPRESSIONS)
            np.add.at(theta["expression"], self._columns, own)
            theta["eyelids"] = np.zeros(2)
            yield TakeFrame(frame.index, theta, frame.camera, frame.image_rgba)


def _same_directions(embedded: HeadArrays, flame: HeadArrays) -> Int[np.ndarray, "E"]:
    """For each expression of the embedded head the one of the synthetic FLAME that is the same."""
    distance, vertex = KDTree(embedded.v_template).query(flame.v_template)
    own, theirs = (arrays.shapedirs.astype(np.float64) for arrays in (embedded, flame))
    own = own[vertex, :, embedded.num_identity :].reshape(3 * FLAME_VERTICES, -1)
    theirs = theirs[..., flame.num_identity :].reshape(3 * FLAME_VERTICES, -1)
    squares = (own**2).sum(0)[:, None] + (theirs**2).sum(0) - 2 * own.T @ theirs
    if distance.max() > _SAME or squares.min(1).max() > 3 * FLAME_VERTICES * _SAME**2:
        raise RuntimeError("The synthetic FLAME is not the embedded head.")
    return squares.argmin(1)
