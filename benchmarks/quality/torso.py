"""How near the tracked body comes to the truth, from pictures alone.

    python benchmarks/quality/torso.py --seeds 5 7 --bodies still lean --json torso.json
    python benchmarks/quality/torso.py --seeds 4 6 --scenes arms neighbour headrest

Films procedural people with shoulders before a patterned wall, or in a harder scene (`scenes.py`),
tracks the pictures as `rgbavatar track` does, and prints the torso's rotation error (mean and
largest, degrees), its middle's distance from the truth (mm; what is constant, and what is left
without that), and the verdict. One camera tells no distance: positions are compared at the head's
true depth. Where the picture's middle is not the camera's, the camera counts as turned to it.
"""

import argparse
import json
import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scenes import Scene, filmed
from scipy.spatial.transform import Rotation

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoFilm, film_demo
from rgbavatar_ns.synthetic.performer.performance import Body
from rgbavatar_ns.synthetic.renderer.raycast import RayCamera
from rgbavatar_ns.tracking import TrackConfig, track_video

FRAMES_PER_SECOND = 15.0


def write_film(film: DemoFilm, scene: Scene, folder: Path) -> Float[np.ndarray, "F 2"]:
    """Pictures of the person in a scene; where the middle of each lies, in the camera's pixels."""
    folder.mkdir(parents=True, exist_ok=True)
    images = (frame.image_rgba for frame in film.frames())
    middles = []
    for number, picture in enumerate(filmed(scene, images, len(film.true))):
        cv2.imwrite(str(folder / f"{number:04d}.png"), picture.image_rgb[..., ::-1])
        middles.append(picture.middle_px)
    return np.array(middles)


def turned_to(middle_px: Float[np.ndarray, "F 2"], camera: RayCamera) -> Float[np.ndarray, "F 3 3"]:
    """From the camera's axes to those of one that looks at these pixels, as trackers assume."""
    right, down = ((middle_px - camera.size / 2) / camera.focal_px).T
    return Rotation.from_rotvec(np.stack([down, right, 0 * right], 1)).as_matrix()


def turns(head: HeadModel, theta: Float[torch.Tensor, "F H"]) -> Float[np.ndarray, "F 3 3"]:
    """The body's rotations."""
    return axis_angle_to_matrix(theta[:, head.layout.slice("rotation")]).double().numpy()


def measure(seed: int, body: Body, scene: Scene, size: int, frames: int) -> dict[str, Any]:
    """One film, tracked and compared."""
    config = DemoConfig(
        image_size=size,
        num_frames=frames,
        num_test_frames=frames // 4,
        seed=seed,
        body=body,
        glasses=False,
        supersampling=2,
        frames_per_second=FRAMES_PER_SECOND,
        theta_noise=0.0,
    )
    film = film_demo(config)
    with tempfile.TemporaryDirectory() as folder:
        middle_px = write_film(film, scene, Path(folder) / "film")
        found = track_video(Path(folder) / "film", Path(folder) / "data", TrackConfig())
        report = json.loads((Path(folder) / "data" / "tracking.json").read_text())
        data = load_dataset(Path(folder) / "data")
        head, kept = HeadModel(data.arrays), list(found.frame_index)
        true, camera = film.true[kept], film.person.camera
        with torch.no_grad():
            ours = head(data.theta, data.identity).double().numpy()
            real = head(true, film.person.identity).double().numpy()
        ours = ours - [0, 0, float(data.cameras.world_to_camera[0, 2, 3])]
        seen_from = turned_to(middle_px[kept], camera)
        real = (real - [0, camera.height_m, camera.distance_m]) @ seen_from.swapaxes(1, 2)
        off = turns(head, data.theta) @ (seen_from @ turns(head, true)).swapaxes(1, 2)
    teeth, torso = (data.arrays.vertex_groups[part] for part in ("upper_teeth", "torso"))
    ours = ours * (real[:, teeth, 2].mean() / ours[:, teeth, 2].mean())
    away_mm = 1e3 * (ours[:, torso].mean(1) - real[:, torso].mean(1))
    degrees = np.degrees(Rotation.from_matrix(off).magnitude())
    return {
        "seed": seed,
        "body": body,
        "scene": scene,
        "rotation_degrees": float(degrees.mean()),
        "worst_rotation_degrees": float(degrees.max()),
        "middle_off_mm": float(np.linalg.norm(away_mm.mean(0))),
        "middle_moves_mm": float(np.linalg.norm(away_mm - away_mm.mean(0), axis=1).mean()),
        "verdict": report["verdict"],
        "told": report["body"],
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one row for each film."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, nargs="+", default=[5, 7])
    parser.add_argument("--bodies", nargs="+", choices=["sway", "still", "lean"], default=["still"])
    parser.add_argument("--scenes", nargs="+", choices=get_args(Scene), default=["plain"])
    parser.add_argument("--size", type=int, default=480)
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    chosen = parser.parse_args(arguments)
    rows = []
    for scene, body, seed in product(chosen.scenes, chosen.bodies, chosen.seeds):
        rows.append(measure(seed, body, scene, chosen.size, chosen.frames))
        print(rows[-1], flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
