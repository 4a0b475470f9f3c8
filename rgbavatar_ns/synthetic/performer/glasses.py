"""Glasses that sit rigidly on the head: a frame of tubes and two reflecting lenses."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rgbavatar_ns.synthetic.performer.surface import unit

_SIDES = 10
_OUTLINE = 44
_RINGS = 6
_LENS_CURVE_M = 0.11


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with smooth normals."""

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]

    def moved(self, rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> "Mesh":
        """The mesh after x -> rotation x + shift."""
        vertices = self.vertices @ rotation.T + shift
        return Mesh(
            vertices.astype(np.float32), (self.normals @ rotation.T).astype(np.float32), self.faces
        )


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32),
        np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)]),
    )


@dataclass(frozen=True)
class Glasses:
    """Frame and lenses in the coordinates of the person's head at rest."""

    frame: Mesh
    lenses: Mesh


def make_glasses(
    left_eye: Float[np.ndarray, "3"], right_eye: Float[np.ndarray, "3"], bridge_z_m: float
) -> Glasses:
    """Fit glasses to the eyeballs' centres; the lenses stand a little before `bridge_z_m`."""
    middle = (left_eye + right_eye) / 2
    half_gap = abs(left_eye[0] - right_eye[0]) / 2 + 0.0035
    centre = np.array([0.0, middle[1] - 0.0035, bridge_z_m + 0.0045])
    tubes, lenses = [], []
    for side in (1.0, -1.0):
        outline = _outline(side, half_gap) + centre
        tubes.append(_tube(outline, 0.00115, closed=True))
        lenses.append(_lens(outline, centre + np.array([side * half_gap, 0, 0])))
        hinge = np.array([side * (half_gap + 0.0265), 0.0075, -0.0075]) + centre
        ear = np.array([side * 0.0745, middle[1] + 0.0060, -0.030])
        bend = np.array([side * 0.0755, middle[1] - 0.014, -0.052])
        corner = np.array([side * (half_gap + 0.0225), 0.0085, -0.0020]) + centre
        arm = np.stack([corner, hinge, 0.5 * (hinge + ear) + [side * 0.003, 0, 0], ear, bend])
        tubes.append(_tube(_refine(arm), 0.0012, closed=False))
    arc = np.linspace(-1, 1, 9)
    inner = half_gap - 0.0215
    bridge = np.stack([arc * inner, 0.0055 + 0.0035 * (1 - arc**2), 0.0022 * (1 - arc**2)], 1)
    tubes.append(_tube(bridge + centre, 0.00115, closed=False))
    return Glasses(joined(tubes), joined(lenses))


def _outline(side: float, half_gap: float) -> np.ndarray:
    """Rim of one lens about the middle between both: a rounded rectangle, bent to the face."""
    angle = np.linspace(0, 2 * np.pi, _OUTLINE, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    x = 0.0235 * np.sign(c) * np.abs(c) ** 0.62
    y = 0.0185 * np.sign(s) * np.abs(s) ** 0.68 + 0.0016 * c * side
    x_world = x + side * half_gap
    return np.stack([x_world, y, -2.2 * x_world**2 - 0.06 * y], 1)


def _lens(outline: np.ndarray, centre: np.ndarray) -> Mesh:
    """A dome within the outline."""
    middle = outline.mean(0)
    levels = np.linspace(0, 1, _RINGS + 1)[1:]
    rings = [middle[None]] + [middle + level * (outline - middle) for level in levels]
    vertices = np.concatenate(rings)
    dome = ((vertices - middle)[:, :2] ** 2).sum(1)
    rim = dome[-_OUTLINE:].max()
    vertices[:, 2] += (rim - dome) / (2 * _LENS_CURVE_M) * 0.6
    faces = []
    for k in range(_OUTLINE):
        following = (k + 1) % _OUTLINE
        faces.append([0, 1 + k, 1 + following])
        for ring in range(_RINGS - 1):
            a, b = 1 + ring * _OUTLINE, 1 + (ring + 1) * _OUTLINE
            faces.append([a + k, b + k, b + following])
            faces.append([a + k, b + following, a + following])
    normals = unit(
        np.concatenate([(vertices - middle)[:, :2] / _LENS_CURVE_M, np.ones((len(vertices), 1))], 1)
        + np.array([1.6 * centre[0], 0.05, 0])
    )
    return Mesh(vertices, normals, np.array(faces))


def _refine(line: np.ndarray, times: int = 2) -> np.ndarray:
    """Round a polyline's corners (Chaikin)."""
    for _ in range(times):
        a, b = line[:-1], line[1:]
        middle = np.stack([0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b], 1).reshape(-1, 3)
        line = np.concatenate([line[:1], middle, line[-1:]])
    return line


def _tube(line: np.ndarray, radius_m: float, closed: bool) -> Mesh:
    """A tube along a polyline."""
    ahead = np.roll(line, -1, 0) - np.roll(line, 1, 0)
    if not closed:
        ahead[0], ahead[-1] = line[1] - line[0], line[-1] - line[-2]
    ahead = unit(ahead)
    helper = (
        np.array([0.0, 0.35, 1.0]) if np.abs(ahead[:, 2]).max() < 0.8 else np.array([0, 1.0, 0])
    )
    first = unit(np.cross(ahead, helper))
    second = np.cross(ahead, first)
    angle = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)[None, :, None]
    normals = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    vertices = line[:, None] + radius_m * normals
    count = len(line)
    faces = []
    for k in range(count if closed else count - 1):
        here, there = k * _SIDES, (k + 1) % count * _SIDES
        for i in range(_SIDES):
            j = (i + 1) % _SIDES
            faces += [[here + i, there + i, there + j], [here + i, there + j, here + j]]
    return Mesh(vertices.reshape(-1, 3), normals.reshape(-1, 3), np.array(faces))
