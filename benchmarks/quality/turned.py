"""Holes and coloured noise of an avatar that is turned: what people see first.

    python benchmarks/quality/turned.py AVATAR DATASET [AVATAR DATASET ...] --json turned.json \
        --picture turned.png

Frames of a dataset are seen from the front and 15, 30 and 60 degrees to either side. "holes" is the
share of pixels of the head's mesh (without neck and shoulders) whose alpha is below .9; "noise" the
energy there of the Laplacian of the two chroma channels, blurred by a pixel, over the frontal
view's. No truth is needed. The picture has a row an avatar: a held-out frame as it is, and turned.
"""

import argparse
import statistics
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from subject import avatars_and_datasets, write_figures, write_picture
from torch import Tensor

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.orbit import head_centre, orbit
from rgbavatar_ns.avatar.prior.placed_mesh import PlacedMesh, covered_pixels
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.head.surface import vertex_normals
from rgbavatar_ns.kernels import PinholeCameras

TURNS_DEG = (0, 15, 30, 60)
_DRAWN_DEG = (0.0, 15.0, 30.0, -15.0, -30.0, 60.0, 180.0)
_ROW_PX = 1792
_FRAMES = 4
_GREY = 0.5
_CB = np.array([-0.168736, -0.331264, 0.5], np.float32)
_CR = np.array([0.5, -0.418688, -0.081312], np.float32)


def chroma_noise(rgb: Float[np.ndarray, "H W 3"], inside: Bool[np.ndarray, "H W"]) -> float:
    """Mean energy of the Laplacian of blurred chroma (JPEG's)."""
    chroma = cv2.GaussianBlur(np.stack([rgb @ _CB, rgb @ _CR], -1), (0, 0), 1)
    return float((cv2.Laplacian(chroma, cv2.CV_32F)[inside] ** 2).sum(-1).mean())


@torch.no_grad()
def turned(
    avatar: Avatar, theta: Float[Tensor, "F H"], cameras: PinholeCameras
) -> dict[str, dict[str, float]]:
    """Holes (a share) and noise (over the front's) by turn; cameras are one, or one a frame."""
    faces = avatar.head.faces.cpu().long()
    of_head = avatar.head.arrays.skinning_weights[:, 0] < 0.5
    head = faces.numpy()[of_head[faces.numpy()].all(1)]
    centre = head_centre(avatar, theta).to(cameras.world_to_camera)
    found: dict[str, dict[str, float]] = {}
    front = 0.0
    for turn in TURNS_DEG:
        holes, noise = [], []
        for yaw in {float(turn), -float(turn)}:
            seen = orbit(cameras, centre, torch.full((len(theta),), yaw), torch.zeros(len(theta)))
            for k in range(len(theta)):
                camera, one = seen.select([k]), theta[[k]]
                drawn = avatar.render(one, camera, torch.full((3,), _GREY))
                vertices = avatar.carrier_vertices(one)
                mesh = PlacedMesh.of(vertices, vertex_normals(vertices, faces), camera, 0)
                inside = covered_pixels(mesh.moved(0.0), head, camera.width, camera.height) > 0
                holes.append(float((drawn.alpha[0, ..., 0].numpy()[inside] < 0.9).mean()))
                noise.append(chroma_noise(drawn.image[0].clamp(0, 1).numpy(), inside))
        front = front or statistics.fmean(noise)
        found[f"turn {turn}"] = {
            "holes": statistics.fmean(holes),
            "noise": statistics.fmean(noise) / front,
        }
    return found


@torch.no_grad()
def sheet(
    avatar: Avatar, theta: Float[Tensor, "1 H"], camera: PinholeCameras
) -> Float[np.ndarray, "height width 3"]:
    """One frame as filmed, to both sides, more to one, and from behind; white background."""
    centre = head_centre(avatar, theta).to(camera.world_to_camera)
    yaws = torch.tensor(_DRAWN_DEG)
    cells = [
        avatar.render(theta, orbit(camera, centre, yaw[None], torch.zeros(1)), torch.ones(3))
        for yaw in yaws
    ]
    row = np.concatenate([cell.image[0].clamp(0, 1).numpy() for cell in cells], 1)
    return cv2.resize(row, (_ROW_PX, round(_ROW_PX * row.shape[0] / row.shape[1])))


def tell_turned(name: str, found: dict[str, dict[str, float]]) -> None:
    """Print a line for each turn."""
    for turn, figures in found.items():
        print(f"{name:<24}{turn:<10}holes {figures['holes']:6.2%}  noise {figures['noise']:5.2f}")


def main() -> None:
    """Measure each avatar on frames that its dataset holds out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("pairs", type=Path, nargs="+", metavar="AVATAR DATASET")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    parser.add_argument("--picture", type=Path, help="also draw them here")
    arguments = parser.parse_args()
    figures, rows = {}, []
    for path, data in avatars_and_datasets(parser, arguments.pairs):
        avatar, dataset = Avatar.load(path), load_dataset(data)
        frames = list(dataset.test)[:: max(1, len(dataset.test) // _FRAMES)][:_FRAMES]
        figures[str(path)] = turned(avatar, dataset.theta[frames], dataset.cameras.select(frames))
        tell_turned(path.name, figures[str(path)])
        if arguments.picture:
            camera = dataset.cameras.select(frames[:1])
            rows.append(sheet(avatar, dataset.theta[frames[:1]], camera))
    write_figures(arguments.json, arguments, avatars=figures)
    if arguments.picture:
        write_picture(arguments.picture, np.concatenate(rows))


if __name__ == "__main__":
    main()
