"""The avatar as one HTML file that plays and drives it in any browser, without a server."""

import base64
import html
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.export.avatar_file import avatar_parts
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.kernels import PinholeCameras

SCRIPTS = (
    "data.js",
    "rotations.js",
    "head.js",
    "weights.js",
    "gaussians.js",
    "shaders.js",
    "renderer.js",
    "pace.js",
    "camera.js",
    "performance.js",
    "panel.js",
    "main.js",
)
"""The page's programs in the order in which they build on one another."""

_LINEAR_RANGE = (-3.0, 3.0)
_NAMED_RANGE = (0.0, 1.0)


@dataclass(frozen=True)
class PageOptions:
    """How the page begins."""

    title: str = "Avatar"
    frames_per_second: float = 25.0
    """Of the performance."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Colour behind the head, each channel in [0, 1]."""


def write_web_page(
    avatar: Avatar,
    path: Path,
    camera: PinholeCameras,
    theta: Float[Tensor, "F H"],
    options: PageOptions | None = None,
    seen: TrainingStatistics | None = None,
) -> int:
    """Write the page and return its size in bytes; nothing in it is loaded from elsewhere.

    camera: where the page's view starts (its first camera). theta: the performance, which may
    have no frames. seen: what the page tells of the film, and how far its camera turns.
    It shows a coarse head before it is all there (avatar_file.py). Raises UserError where the file
    cannot be written.
    """
    options = PageOptions() if options is None else options
    manifest = _manifest(avatar, camera, theta, options) | {"film": _film(avatar, seen)}
    parts = avatar_parts(avatar, manifest, theta, {})
    content = _assemble(parts, options.title).encode()
    with atomic_write(path) as partial:
        partial.write_bytes(content)
    return len(content)


@torch.no_grad()
def _manifest(
    avatar: Avatar, camera: PinholeCameras, theta: Float[Tensor, "F H"], options: PageOptions
) -> dict[str, Any]:
    config, layout = avatar.config, avatar.layout
    rest = theta.new_zeros(1, layout.size)
    seen = torch.cat([rest, theta]).to(avatar.identity)
    expression = seen[:, layout.slice("expression")]
    names = avatar.head.arrays.expression_names
    # Blend shapes named after what they do run from 0 to 1; numbered components to both sides.
    numbered = bool((expression < -0.05).any()) or all(n[-1:].isdigit() for n in names)
    low, high = _LINEAR_RANGE if numbered else _NAMED_RANGE
    strength = expression.std(0, unbiased=False)
    psi = avatar.weights(seen).abs().amax(0)
    return {
        "num_bases": config.num_bases,
        "variant": config.tangent_variant,
        "carrier": config.carrier,
        "scale_with_triangle": config.scale_with_triangle,
        "pose_input": config.pose_input,
        "translation_input": config.translation_input,
        "layout": layout.to_json(),
        "parents": [int(parent) for parent in avatar.head.arrays.parents],
        "expression_names": list(names),
        "expression_range": [
            expression.amin(0).clamp(max=low).tolist(),
            expression.amax(0).clamp(min=high).tolist(),
        ],
        "expression_order": torch.argsort(strength, descending=True, stable=True).tolist(),
        "psi_range": (1.5 * psi).clamp(min=0.1).tolist(),
        "camera": {
            "rotation": camera.world_to_camera[0, :3, :3].flatten().tolist(),
            "translation": camera.world_to_camera[0, :3, 3].tolist(),
            "focal": camera.focal_px[0].tolist(),
            "principal": camera.principal_point_px[0].tolist(),
            "width": camera.width,
            "height": camera.height,
        },
        "background": list(options.background),
        "frames_per_second": options.frames_per_second,
    }


def _film(avatar: Avatar, seen: TrainingStatistics | None) -> dict[str, Any]:
    """What counts as filmed: lowest and highest yaw and pitch in radians, lowest and highest theta.

    Of an avatar that brings no statistics, theta's range is None and the turns are those of most
    films.
    """
    rest = torch.zeros(1, avatar.layout.size)
    known = seen or TrainingStatistics.of(rest, torch.zeros(1, 1), avatar.layout)
    turns = (known.filmed_turns(), known.turn_reach())
    turn, reach = ([end.deg2rad().tolist() for end in ends] for ends in turns)
    theta = None if seen is None else [end.tolist() for end in seen.film_range()]
    return {"turn": turn, "turn_reach": reach, "theta": theta}


def _assemble(parts: list[bytes], title: str) -> str:
    """Fill the page's template; a script element for each part, after the programs."""
    folder = resources.files("rgbavatar_ns.export") / "web"
    scripts = "\n".join(
        f"<script>\n{(folder / name).read_text(encoding='utf-8')}</script>" for name in SCRIPTS
    )
    payload = "\n".join(
        '<script type="application/octet-stream" class="part">'
        f"{base64.b64encode(part).decode('ascii')}</script>"
        for part in parts
    )
    filled = {
        "title": html.escape(title),
        "style": (folder / "style.css").read_text(encoding="utf-8"),
        "scripts": scripts,
        "parts": payload,
    }
    page = (folder / "page.html").read_text(encoding="utf-8")
    # In one pass: what is filled in is not looked at again.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: filled[found[1]], page)
