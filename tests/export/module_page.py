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


def load_avatar(page: Any, options: str = "{}") -> None:
    """Have the first canvas show the folder's avatar, as `avatar`."""
    page.evaluate(
        "async () => { window.avatar = await module.RGBAvatar.load('avatar.rgba',"
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
