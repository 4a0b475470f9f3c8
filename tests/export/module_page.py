"""A page with the ES module, for its tests."""

import base64
import io
from typing import Any

import numpy as np
import torch
from PIL import Image

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.export import draw, front_camera
from rgbavatar_ns.kernels import PinholeCameras

SIZE = 96
"""Of a canvas, in pixels."""
PAGE = """<!doctype html>
<style>canvas { width: 96px; height: 96px; display: block; }</style>
<canvas></canvas><canvas></canvas>
<script type="module">
  import * as module from "./rgbavatar.js";
  window.module = module;
</script>"""
"""Two canvases, and the module as `module`."""


def load_avatar(page: Any, options: str = "{}", file: str = "avatar.rgba") -> None:
    """Have the first canvas show an avatar of the folder, as `avatar`."""
    page.evaluate(
        f"async () => {{ window.avatar = await module.RGBAvatar.load('{file}',"
        f" document.querySelector('canvas'), {options}); await avatar.complete; }}"
    )


def canvas_of(page: Any, name: str = "avatar") -> np.ndarray:
    """The canvas [H, W, 4] with straight alpha in [0, 1], drawn now."""
    text = page.evaluate(f"() => {{ {name}.draw(); return {name}.canvas.toDataURL('image/png'); }}")
    image = Image.open(io.BytesIO(base64.b64decode(text.split(",")[1])))
    return np.asarray(image.convert("RGBA")).astype(np.float32) / 255


def drawn_by_us(
    avatar: Avatar, theta: torch.Tensor, cameras: PinholeCameras | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The picture on white, and its alpha; theta: one."""
    cameras = front_camera(avatar, SIZE, SIZE) if cameras is None else cameras
    drawn = draw(avatar, theta[None], cameras, (1.0, 1.0, 1.0))
    return drawn.image[0].clamp(0, 1).numpy(), drawn.alpha[0].numpy()


def foreign_camera(width: int, height: int) -> tuple[PinholeCameras, list[float], list[float]]:
    """A camera beside the head, with its view and projection matrices as OpenGL has them."""
    right = np.array([0.9, 0.0, -0.4]) / np.hypot(0.9, 0.4)
    up = np.array([0.0, 1.0, 0.0])
    backward = np.cross(right, up)
    view = np.eye(4)
    view[:3, :3] = np.stack([right, up, backward])
    view[:3, 3] = -view[:3, :3] @ (0.9 * backward + [0.01, 0.02, 0.03])
    near, far, scale = 0.1, 10.0, 3.1
    projection = np.zeros((4, 4))
    projection[0] = [scale * height / width, 0, 0.1, 0]
    projection[1] = [0, scale, -0.2, 0]
    projection[2] = [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)]
    projection[3, 2] = -1

    # By hand: a pixel is (x' + 1) w / 2, (1 - y') h / 2 of the projected point (x', y').
    def pixel(point: np.ndarray) -> np.ndarray:
        clip = projection @ view @ np.append(point, 1)
        x, y = clip[:2] / clip[3]
        return np.array([(x + 1) * width / 2, (1 - y) * height / 2])

    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0]) @ view
    origin = np.linalg.inv(view)[:3, 3]
    centre = pixel(origin - backward)
    focal = (
        pixel(origin - backward + right)[0] - centre[0],
        centre[1] - pixel(origin - backward + up)[1],
    )
    cameras = PinholeCameras(
        torch.from_numpy(world_to_camera)[None].float(),
        torch.tensor([focal], dtype=torch.float32),
        torch.from_numpy(centre)[None].float(),
        width,
        height,
    )
    return cameras, view.T.flatten().tolist(), projection.T.flatten().tolist()
