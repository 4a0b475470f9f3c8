"""Find FaceMesh's points on the embedded head by looking at renders of it with FaceMesh.

    python scripts/build_landmark_map.py [--picture overlay.png]

writes `rgbavatar_ns/head/assets/facemesh_landmarks.npz`. Painted heads of several identities are
rendered from several sides, with the mouth shut and a little open; each detected point is taken
back to the nearest visible place on the skin (irises: on the eyeball); the places' median over all
renders, made symmetric, is the point's place. Needs mediapipe.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import mediapipe
import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.landmarks import LANDMARK_FILE

SIZE_PX, FOCAL_PX, DISTANCE_M = 640, 1500.0, 0.75
FIRST_IRIS = 468
MIDDLE = [0, 1, 4, 5, 6, 8, 9, 10, 17, 152, 168]
"""FaceMesh points on the middle of the face."""
SKIN_CELL_BOTTOM = 48 / 256
"""The outer skin is the part of the UV map above this v; mouth and sockets lie below."""
SAMPLES = (
    np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2], [3, 3, 0], [3, 0, 3], [0, 3, 3]]) / 6
)


@dataclass(frozen=True)
class Look:
    """One render: who, with which jaw angle, turned how, lit from where."""

    identity: torch.Tensor
    jaw: float
    yaw: float
    pitch: float
    light: np.ndarray


def looks(num_identity: int) -> list[Look]:
    """The average head and a few random ones from seven sides, mouth shut and open in turn."""
    generator = np.random.default_rng(0)
    result = []
    for person in range(4):
        coefficients = generator.normal(size=num_identity) * 0.6 * (person > 0)
        for number, (yaw, pitch) in enumerate(
            [(0, 0), (0.15, 0), (-0.15, 0), (0, 0.12), (0, -0.12), (0.3, 0.05), (-0.3, 0.05)]
        ):
            light = np.array([generator.uniform(-0.5, 0.5), generator.uniform(0, 0.6), 1])
            jaw = 0.2 * ((person + number) % 2)
            identity = torch.tensor(coefficients, dtype=torch.float32)
            result.append(Look(identity, jaw, yaw, pitch, light / np.linalg.norm(light)))
    return result


def albedo(head: HeadModel, rest: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Painted colour [N, 3] at places of the head at rest: hair, brows, lips, lashes, irises."""
    x, y, z = np.abs(rest[:, 0]), rest[:, 1], rest[:, 2]
    color = np.tile([0.82, 0.6, 0.5], (len(rest), 1))
    hair = (y > 0.1 - 0.4 * np.maximum(0.045 - z, 0)) | ((z < -0.03) & (y > -0.06))
    color[hair] = [0.16, 0.1, 0.07]
    arch = 0.0475 + 0.006 * np.sin(np.clip((x - 0.012) / 0.042, 0, 1) * 2.6)
    thick = 0.0035 * np.clip((0.056 - x) / 0.02, 0.25, 1)
    color[(np.abs(y - arch) < thick) & (x > 0.012) & (x < 0.054) & (z > 0)] = [0.2, 0.13, 0.09]
    reach = np.clip(1 - (x / 0.025) ** 2, 0, None)
    lips = (y < -0.037 + 0.0095 * reach**0.7) & (y > -0.037 - 0.0125 * reach) & (x < 0.025)
    color[lips & (z > 0.035)] = [0.68, 0.3, 0.29]
    uv_of = head.arrays.uv[head.arrays.uv_faces][..., 1].min(1) < SKIN_CELL_BOTTOM
    inner = np.unique(head.arrays.faces[uv_of])
    outer = np.unique(head.arrays.faces[~uv_of])
    rims = np.intersect1d(inner, outer)
    rims = rims[head.arrays.v_template[rims, 1] > 0]
    lash = KDTree(head.arrays.v_template[rims]).query(rest)[0] < 0.0013
    color[lash] = [0.12, 0.08, 0.07]
    for name, centre_x in (("left_eye", 1), ("right_eye", -1)):
        eye = part == name
        centre = head.joints().numpy()[3 if centre_x > 0 else 4]
        ray = rest[eye] - centre
        angle = np.arccos(np.clip(ray[:, 2] / np.linalg.norm(ray, axis=1), -1, 1))
        shades = np.where(angle[:, None] < 0.43, [0.25, 0.2, 0.14], [0.93, 0.92, 0.9])
        color[eye] = np.where(angle[:, None] < 0.18, [0.03, 0.03, 0.03], shades)
    color[np.isin(part, ["upper_teeth", "lower_teeth"])] = [0.92, 0.9, 0.84]
    color[part == "tongue"] = [0.6, 0.28, 0.28]
    color[part == "inner"] = [0.25, 0.08, 0.08]
    return color


class Painter:
    """Renders looks of the head and takes pixels back to its surface."""

    def __init__(self, head: HeadModel) -> None:
        self.head, self.faces = head, head.arrays.faces
        self.rest = head.arrays.v_template
        self.face_part = np.empty(len(self.faces), dtype="U12")
        for name, vertices in head.arrays.vertex_groups.items():
            self.face_part[np.isin(self.faces[:, 0], vertices)] = name
        below = head.arrays.uv[head.arrays.uv_faces][..., 1].min(1) < SKIN_CELL_BOTTOM
        self.face_part[(self.face_part == "skin") & below] = "inner"

    def vertices(self, look: Look) -> np.ndarray:
        """Posed head in the camera's frame: x right, y up, looking along -z from the origin."""
        theta = torch.zeros(self.head.layout.size)
        theta[self.head.layout.slice("jaw")] = torch.tensor([look.jaw, 0, 0])
        theta[self.head.layout.slice("rotation")] = torch.tensor([look.pitch, look.yaw, 0])
        with torch.no_grad():
            posed = self.head(theta, look.identity).numpy()
        eyes = posed[self.head.arrays.vertex_groups["left_eye"]].mean(0) / 2
        eyes = eyes + posed[self.head.arrays.vertex_groups["right_eye"]].mean(0) / 2
        return (posed - eyes + [0, 0.02, -DISTANCE_M]).astype(np.float32)

    def render(self, look: Look, vertices: np.ndarray) -> np.ndarray:
        """The painted head as uint8 [H, W, 3]."""
        offsets = np.arange(SIZE_PX) + 0.5 - SIZE_PX / 2
        right, down = np.meshgrid(offsets, offsets)
        rays = np.stack([right, -down, np.full_like(right, -FOCAL_PX)], -1).reshape(-1, 3)
        triangle, weights = intersect(vertices[self.faces], rays)
        hit = triangle >= 0
        corners = self.faces[triangle[hit]]
        rest = np.einsum("nk,nkc->nc", weights[hit], self.rest[corners])
        color = albedo(self.head, rest, self.face_part[triangle[hit]])
        normals = np.einsum(
            "nk,nkc->nc", weights[hit], vertex_normals(vertices, self.faces)[corners]
        )
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        light = 0.35 + 0.65 * np.clip(0.15 + 0.85 * normals @ look.light, 0, 1)
        image = np.full((SIZE_PX**2, 3), 0.55)
        image[hit] = color * light[:, None]
        return (image.reshape(SIZE_PX, SIZE_PX, 3).clip(0, 1) ** (1 / 1.6) * 255).astype(np.uint8)

    def back_project(self, vertices: np.ndarray, points_px: np.ndarray) -> np.ndarray:
        """Rest positions [478, 3] of the visible places nearest to the points' rays."""
        places = np.empty((len(points_px), 3))
        is_iris = np.arange(len(points_px)) >= FIRST_IRIS
        eyes = np.isin(self.face_part, ["left_eye", "right_eye"])
        for chosen, triangles in ((~is_iris, self.face_part == "skin"), (is_iris, eyes)):
            index = np.flatnonzero(triangles)
            seen = np.einsum("sk,fkc->fsc", SAMPLES, vertices[self.faces[index]]).reshape(-1, 3)
            rest = np.einsum("sk,fkc->fsc", SAMPLES, self.rest[self.faces[index]]).reshape(-1, 3)
            # From the sample towards the camera: what is met first must be the sample's own.
            hit, distance = first_hit(vertices[self.faces[index]], seen)
            visible = (hit >= 0) & (distance > np.linalg.norm(seen, axis=1) - 5e-4)
            seen, rest = seen[visible], rest[visible]
            pixels = seen[:, :2] / -seen[:, 2:] * FOCAL_PX * [1, -1] + SIZE_PX / 2
            nearest = KDTree(pixels).query(points_px[chosen], k=3)
            closeness = 1 / (nearest[0] + 0.3)
            closeness /= closeness.sum(1, keepdims=True)
            places[chosen] = (rest[nearest[1]] * closeness[..., None]).sum(1)
        return places


def intersect(triangles: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First triangle met by rays from the origin (-1: none) and barycentric coordinates."""
    scene = EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(triangles, dtype=np.float32))
    directions = np.ascontiguousarray(rays, dtype=np.float32)
    found = scene.run(np.zeros_like(directions), directions, query="INTERSECT", output=1)
    u, v = found["u"], found["v"]
    return found["primID"], np.stack([1 - u - v, u, v], 1)


def first_hit(triangles: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Along the rays from the origin to the points: triangle met first and its distance."""
    lengths = np.linalg.norm(points, axis=1, keepdims=True)
    hit, weights = intersect(triangles, points / lengths)
    met = np.einsum("nk,nkc->nc", weights, triangles[hit])
    return hit, np.linalg.norm(met, axis=1)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted normals, not of length one."""
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], cross)
    return normals


def face_mesh() -> Any:
    """The detector, for unrelated images."""
    return mediapipe.solutions.face_mesh.FaceMesh(  # pyright: ignore[reportAttributeAccessIssue]
        static_image_mode=True, refine_landmarks=True, min_detection_confidence=0.2
    )


def detect(detector: Any, image: np.ndarray) -> np.ndarray | None:
    """FaceMesh's 478 points in pixels [478, 2], or None where it finds no face."""
    found = detector.process(image).multi_face_landmarks
    if not found:
        return None
    return np.array([[mark.x, mark.y] for mark in found[0].landmark]) * SIZE_PX


def mirror_table(painter: Painter) -> np.ndarray:
    """Each point's partner on the other side [478], from faces seen straight on, mouth open.

    Points are paired one to one so that the mirrored face lies nearest to the face. The irises
    have a known order: centre, then right, top, left, bottom in the image, the right eye first.
    """
    faces = []
    average = torch.zeros(painter.head.num_identity)
    with face_mesh() as detector:
        for jaw in (0.2, 0.3, 0.4):
            look = Look(average, jaw, 0.0, 0.0, np.array([0, 0.3, 0.95]))
            image = painter.render(look, painter.vertices(look))
            for seen in (image, np.ascontiguousarray(image[:, ::-1])):
                found = detector.process(seen).multi_face_landmarks[0].landmark
                faces.append([[mark.x - 0.5, mark.y - 0.5, mark.z] for mark in found])
    face = np.mean(faces, 0)[:FIRST_IRIS]
    face[:, 0] -= face[MIDDLE, 0].mean()
    cost = ((face[:, None] * [-1, 1, 1] - face[None]) ** 2).sum(-1)
    partner = linear_sum_assignment(cost)[1]
    if (partner[partner] != np.arange(len(partner))).any():
        raise SystemExit("FaceMesh's points could not be paired across the face.")
    return np.concatenate([partner, FIRST_IRIS + np.array([5, 8, 7, 6, 9, 0, 3, 2, 1, 4])])


def on_mouth(places: np.ndarray) -> np.ndarray:
    """Whether places of the head at rest [..., 3] lie on the lips or their border."""
    x, y = np.abs(places[..., 0]), places[..., 1]
    return (x < 0.026) & (y > -0.052) & (y < -0.024)


def place_on_mesh(
    painter: Painter, places: np.ndarray, jaw: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangle [L] and barycentric coordinates [L, 3] of the surface's nearest places.

    On the mouth a point stays on its own lip.
    """
    rest, faces = painter.rest, painter.faces
    face_jaw = painter.head.arrays.skinning_weights[faces][..., 2].mean(1)
    triangles, weights = np.empty(len(places), np.int64), np.empty((len(places), 3))
    for number, place in enumerate(places):
        if number < FIRST_IRIS:
            allowed = painter.face_part == "skin"
        else:
            allowed = painter.face_part == ("left_eye" if place[0] > 0 else "right_eye")
        if on_mouth(place):
            allowed = allowed & ((face_jaw > 0.5) == (jaw[number] > 0.5))
        index = np.flatnonzero(allowed)
        near = np.linalg.norm(rest[faces[index]].mean(1) - place, axis=1)
        index = index[np.argsort(near)[:60]]
        corners = rest[faces[index]].astype(np.float64)
        found = closest_point(corners, np.tile(place, (len(index), 1)))
        best = np.linalg.norm(found - place, axis=1).argmin()
        triangles[number] = index[best]
        solution = np.linalg.lstsq(
            np.concatenate([corners[best].T, np.ones((1, 3))]),
            np.append(found[best], 1),
            rcond=None,
        )[0].clip(0)
        weights[number] = solution / solution.sum()
    return triangles, weights


def build(painter: Painter) -> dict[str, np.ndarray]:
    """The asset's arrays."""
    votes, opened = [], []
    with face_mesh() as detector:
        for look in looks(painter.head.num_identity):
            vertices = painter.vertices(look)
            points_px = detect(detector, painter.render(look, vertices))
            if points_px is not None:
                votes.append(painter.back_project(vertices, points_px))
                opened.append(look.jaw > 0)
    print(f"FaceMesh found the face in {len(votes)} renders")
    table, opened = np.stack(votes), np.array(opened)
    # Only an open mouth tells the lips apart.
    table[np.ix_(~opened, on_mouth(np.median(table, 0)))] = np.nan
    places = np.nanmedian(table, 0)
    nearest = np.asarray(KDTree(painter.rest).query(np.nan_to_num(table))[1])
    jaw = np.median(painter.head.arrays.skinning_weights[nearest[opened], 2], 0)
    mirror = mirror_table(painter)
    print(f"asymmetry: {np.abs(places - places[mirror] * [-1, 1, 1]).max() * 1e3:.1f} mm at most")
    places = (places + places[mirror] * [-1, 1, 1]) / 2
    jaw = (jaw + jaw[mirror]) / 2
    triangle, barycentric = place_on_mesh(painter, places, jaw)
    spread = np.nanmedian(np.linalg.norm(table - places, axis=2), 0)
    print(f"spread over renders: median {np.median(spread) * 1e3:.1f} mm")
    return {
        "facemesh_index": np.arange(len(places), dtype=np.int32),
        "triangle": triangle.astype(np.int32),
        "barycentric": barycentric.astype(np.float32),
        "mirror": mirror.astype(np.int32),
        "spread_m": spread.astype(np.float32),
    }


def overlay(painter: Painter, arrays: dict[str, np.ndarray], path: Path) -> None:
    """Draw the map's points (green) on renders, beside FaceMesh's own detection there (red)."""
    pictures = []
    with face_mesh() as detector:
        for look in looks(painter.head.num_identity)[:2]:
            vertices = painter.vertices(look)
            image = painter.render(look, vertices)
            corners = vertices[painter.faces[arrays["triangle"]]]
            points = np.einsum("nk,nkc->nc", arrays["barycentric"], corners)
            ours = points[:, :2] / -points[:, 2:] * FOCAL_PX * [1, -1] + SIZE_PX / 2
            picture = np.kron(image, np.ones((2, 2, 1), np.uint8))
            for marks, color in ((detect(detector, image), (255, 0, 0)), (ours, (0, 255, 0))):
                for x, y in np.empty((0, 2)) if marks is None else marks:
                    row, column = int(2 * y), int(2 * x)
                    picture[row - 1 : row + 2, column - 1 : column + 2] = color
            pictures.append(picture)
    imageio.imwrite(path, np.concatenate(pictures, 1))


def main() -> None:
    """Write the asset, and a picture where one is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    painter = Painter(HeadModel.embedded())
    arrays = build(painter)
    with atomic_write(LANDMARK_FILE) as partial:
        np.savez_compressed(partial, **arrays)  # pyright: ignore[reportArgumentType]
    print(f"{LANDMARK_FILE.name}: {LANDMARK_FILE.stat().st_size / 1e3:.0f} kB")
    if arguments.picture:
        overlay(painter, arrays, arguments.picture)


if __name__ == "__main__":
    main()
