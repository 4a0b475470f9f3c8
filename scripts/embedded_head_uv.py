"""Lay the head's charts out anew, so that nearly every texel of the UV square is covered."""

from itertools import pairwise

import numpy as np
from embedded_head_parts import HeadMesh
from uv_charts import boundary_loops, flatten_to_rectangle

GRID = 256
MARGIN = 1.6
"""Distance of a chart from its cell's border, in texels of a 256 x 256 map."""

CELLS = {
    "skin": (0, 48, 256, 208),
    "left_eye_front": (48, 0, 48, 48),
    "right_eye_front": (0, 0, 48, 48),
    "tongue": (96, 0, 48, 48),
    "upper_teeth": (144, 32, 72, 16),
    "lower_teeth": (144, 16, 72, 16),
    "right_socket": (144, 0, 24, 16),
    "left_socket": (168, 0, 24, 16),
    "right_eye_back": (192, 0, 12, 16),
    "left_eye_back": (204, 0, 12, 16),
    "mouth": (216, 0, 40, 48),
}
"""Left, bottom, width and height of each chart's cell, in texels of a 256 x 256 map."""


def _chart_names(mesh: HeadMesh) -> np.ndarray:
    """Which cell each triangle goes to [F].

    The charts are MakeHuman's, except that its face and its neck become one, and the sockets and
    the mouth's bag are told by their place.
    """
    parent = np.arange(len(mesh.guide_uv))
    while True:
        lowest = parent[mesh.guide_faces].min(1)
        updated = parent.copy()
        for corner in range(3):
            np.minimum.at(updated, mesh.guide_faces[:, corner], lowest)
        if (updated == parent).all():
            break
        parent = updated
    chart = parent[mesh.guide_faces[:, 0]]
    names = np.empty(len(chart), dtype="U16")
    centres = mesh.vertices[mesh.faces].mean(1)
    for label in np.unique(chart):
        inside = chart == label
        part = mesh.face_parts[inside][0]
        centre = centres[inside].mean(0)
        if part in ("left_eye", "right_eye"):
            eye = mesh.eye_centre(part)
            part = f"{part}_front" if centre[2] > eye[2] else f"{part}_back"
        elif part == "skin":
            width = np.ptp(centres[inside][:, 0])
            if width < 0.05:
                part = "left_socket" if centre[0] > 0 else "right_socket"
            elif width < 0.09:
                part = "mouth"
        names[inside] = part
    return names


def _back_seam(mesh: HeadMesh, faces: np.ndarray) -> list[int]:
    """Vertices along the middle of the back, from the lower border up over the crown."""
    middle = np.unique(faces)
    middle = set(middle[np.abs(mesh.vertices[middle, 0]) < 1e-5].tolist())
    neighbours: dict[int, set[int]] = {}
    for face in faces.tolist():
        for vertex in face:
            if vertex in middle:
                neighbours.setdefault(vertex, set()).update(middle.intersection(face) - {vertex})
    border = [vertex for vertex in boundary_loops(faces)[0] if vertex in middle]
    path = [min(border, key=lambda vertex: mesh.vertices[vertex, 2])]
    crown = mesh.vertices[:, 1].max()
    while True:
        following = neighbours[path[-1]] - set(path)
        step = {v: mesh.vertices[v] - mesh.vertices[path[-1]] for v in following}
        vertex = min(following, key=lambda v: np.linalg.norm(step[v]))
        path.append(vertex)
        position = mesh.vertices[vertex]
        if position[2] > 0 and position[1] > crown - 0.08:
            return path


def _cut_open(faces: np.ndarray, seam: list[int], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces with the seam's vertices doubled on the subject's left, and the new vertices' origin.

    The seam's last vertex stays single, it is where the cut ends.
    """
    directed = {}
    for index, face in enumerate(faces.tolist()):
        for start, end in zip(face, face[1:] + face[:1]):
            directed[start, end] = index
    cut_edges = {frozenset(edge) for edge in pairwise(seam)}
    opened = faces.copy()
    origins = []
    for place, vertex in enumerate(seam[:-1]):
        # Walk from the face left of the seam's edge around the vertex until the next cut.
        face = directed[vertex, seam[place + 1]]
        side = []
        while face is not None:
            side.append(face)
            corners = faces[face].tolist()
            before = corners[corners.index(vertex) - 1]
            crossing = frozenset((before, vertex))
            face = None if crossing in cut_edges else directed.get((vertex, before))
        copy = count + len(origins)
        for index in side:
            opened[index][faces[index] == vertex] = copy
        origins.append(vertex)
    return opened, np.array(origins)


def _density(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Wanted texels per area of the skin, relative: face 1, eyes and lips more, the rest less."""
    centres = points[faces].mean(1)
    x, y, z = np.abs(centres[:, 0]), centres[:, 1], centres[:, 2]

    def ramp(value: np.ndarray, low: float, high: float) -> np.ndarray:
        t = ((value - low) / (high - low)).clip(0, 1)
        return t * t * (3 - 2 * t)

    face = ramp(z, -0.02, 0.03) * ramp(y, -0.105, -0.07) * (1 - ramp(y, 0.09, 0.13))
    density = 0.22 + 0.78 * face
    density *= 0.45 + 0.55 * ramp(y, -0.16, -0.11)
    for place, radius in (((0.031, 0.03), 0.024), ((0.012, -0.036), 0.026)):
        near = np.hypot(x - place[0], y - place[1])
        density *= 1 + 1.0 * face * (1 - ramp(near, 0.5 * radius, 1.5 * radius))
    return density


def _corners(loop: list[int], guide: np.ndarray) -> list[int]:
    """Border vertices nearest the guide's four corners, anticlockwise from the lower left."""
    centred = guide[loop] - (guide[loop].min(0) + guide[loop].max(0)) / 2
    centred = centred / np.ptp(guide[loop], axis=0)
    wanted = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return [loop[int((centred @ direction).argmax())] for direction in wanted]


def _flatten_chart(mesh: HeadMesh, name: str, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """UV of one chart's corners: points [N, 2] and faces [F, 3] into them, in texels."""
    faces = mesh.faces[inside]
    size = (CELLS[name][2] - 2 * MARGIN, CELLS[name][3] - 2 * MARGIN)
    points, guide = mesh.vertices, mesh.vertices[:, :2]
    seam, origins = [], np.array([], np.int64)
    if name == "skin":
        seam = _back_seam(mesh, faces)
        faces, origins = _cut_open(faces, seam, len(points))
        points = np.concatenate([points, points[origins]])
    elif name == "tongue":
        texture = mesh.guide_faces[inside]
        points = np.zeros((len(mesh.guide_uv), 3))
        points[texture] = mesh.vertices[faces]
        faces, guide = texture, mesh.guide_uv
    elif name.endswith("teeth"):
        guide = np.zeros((len(points), 2))
        guide[faces] = mesh.guide_uv[mesh.guide_faces[inside]]
    used, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    loop = boundary_loops(local)[0]
    density = np.ones(len(local))
    if name == "skin":
        density = _density(points[used], local)
        corners = _skin_corners(points, used, seam, origins, len(mesh.vertices))
    else:
        if name.endswith("back"):
            guide = guide * [-1, 1]
        corners = _corners(loop, guide[used])
        if name.endswith("front"):
            centres = points[used][local].mean(1)
            density = 0.5 + 1.5 * (centres[:, 2] > np.quantile(points[used][:, 2], 0.6))
    return flatten_to_rectangle(points[used], local, corners, size, density), local


def _skin_corners(
    points: np.ndarray, used: np.ndarray, seam: list[int], origins: np.ndarray, count: int
) -> list[int]:
    """Lower ends of the cut and the places on it where the map's upper corners shall be."""
    upper = int(np.argmin(np.abs(points[seam][:, 1] - (points[:, 1].max() - 0.05))))
    local = {int(vertex): index for index, vertex in enumerate(used)}
    copies = {int(vertex): count + index for index, vertex in enumerate(origins)}
    originals = [local[seam[0]], local[seam[upper]]]
    doubles = [local[copies[seam[0]]], local[copies[seam[upper]]]]
    return [originals[0], doubles[0], doubles[1], originals[1]]


def layout_uv(mesh: HeadMesh) -> tuple[np.ndarray, np.ndarray]:
    """New UV [VT, 2] in [0, 1] and faces [F, 3] into it."""
    names = _chart_names(mesh)
    uv_faces = np.zeros_like(mesh.faces)
    pieces, count = [], 0
    for name, (left, bottom, _, _) in CELLS.items():
        inside = names == name
        points, faces = _flatten_chart(mesh, name, inside)
        pieces.append((points + np.array([left + MARGIN, bottom + MARGIN])) / GRID)
        uv_faces[inside] = faces + count
        count += len(points)
    return np.concatenate(pieces), uv_faces
