"""The avatar as one HTML file that plays and drives it in any browser, without a server."""

import base64
import gzip
import html
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.web_arrays import (
    Arrays,
    gaussian_arrays,
    head_arrays,
    network_arrays,
    pack,
)
from rgbavatar_ns.export.web_scripts import PAGE_SCRIPTS, sources, web_text
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.head.arkit import ARKIT_NAMES, ArkitMap
from rgbavatar_ns.kernels import PinholeCameras

_LINEAR_RANGE = (-3.0, 3.0)
_NAMED_RANGE = (0.0, 1.0)
_LOOPBACK = ("127.0.0.1", "localhost")
"""Without [::1], which a content security policy cannot name."""
_HOST = r"([a-z0-9-]+\.)*[a-z0-9-]+(:[0-9]{1,5})?"
_DEFAULT_PORTS = {"http": ":80", "ws": ":80", "https": ":443", "wss": ":443"}


@dataclass(frozen=True)
class PageOptions:
    """How the page begins, and who may speak to it."""

    title: str = "Avatar"
    frames_per_second: float = 25.0
    """Of the performance."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Colour behind the head, each channel in [0, 1]."""
    origins: tuple[str, ...] = ()
    """Of other pages whose messages (postMessage) it takes, such as https://example.org."""
    servers: tuple[str, ...] = ()
    """That may drive it (`?ws=`) beside programs on its own machine, such as wss://example.org."""

    def __post_init__(self) -> None:
        """Raise UserError for what is no origin or no server."""
        for text in self.origins:
            _check_address(text, "origin", ("https", "http"))
        for text in self.servers:
            _check_address(text, "server", ("wss", "ws"))


def write_web_page(
    avatar: Avatar,
    path: Path,
    camera: PinholeCameras,
    theta: Float[Tensor, "F H"],
    options: PageOptions | None = None,
    seen: TrainingStatistics | None = None,
    neutral: Float[Tensor, "H"] | None = None,
) -> int:
    """Write the page and return its size in bytes; nothing in it is loaded from elsewhere.

    camera: where the page's view starts (its first camera). theta: the performance, which may
    have no frames. seen: what the page tells of the film, and how far its camera turns. neutral:
    what it shows at rest, by default the head at rest (`calm_theta`).
    The bases are kept in 8 bits with a unit for each component. Raises UserError where the file
    cannot be written.
    """
    options = PageOptions() if options is None else options
    layers, network = network_arrays(avatar)
    driving = _driving_arrays(avatar, theta, neutral)
    directory, block = pack(head_arrays(avatar) | gaussian_arrays(avatar) | network | driving)
    manifest = _manifest(avatar, camera, theta, options)
    manifest |= {"film": _film(avatar, seen), "network": layers, "arrays": directory}
    content = _assemble(manifest, block, options).encode()
    with atomic_write(path) as partial:
        partial.write_bytes(content)
    return len(content)


def calm_theta(
    seen: TrainingStatistics | None, posed: Float[Tensor, "H"]
) -> Float[Tensor, "H"]:
    """The film's calmest expression in the pose of another frame; that frame's where none is known.

    Zeros are no calm face: what a person's tracked head has at rest is seldom zero.
    """
    return posed if seen is None else torch.where(seen.expressive, seen.theta_neutral, posed)


def _check_address(text: str, kind: str, schemes: tuple[str, ...]) -> None:
    """Raise UserError unless the text is an address as the browser writes it."""
    scheme, _, host = text.partition("://")
    if scheme not in schemes or not re.fullmatch(_HOST, host) or host.endswith(
        _DEFAULT_PORTS[scheme]
    ):
        raise UserError(
            f"{text!r} is no {kind} of a page.",
            f"Write it as browsers do, in small letters, without a path and without the usual "
            f"port: {schemes[0]}://example.org or {schemes[1]}://localhost:8000.",
        )


def _driving_arrays(
    avatar: Avatar, theta: Float[Tensor, "F H"], neutral: Float[Tensor, "H"] | None
) -> Arrays:
    """The performance and the face at rest; what ARKit's coefficients do, if that is known."""
    calm = theta.new_zeros(avatar.layout.size) if neutral is None else neutral
    numbers = {"theta": theta, "neutral_theta": calm}
    arrays = {name: tensor.detach().cpu().numpy() for name, tensor in numbers.items()}
    known = _arkit(avatar)
    if known is not None:
        arrays["arkit_theta"] = known.theta_per_unit
    return {name: values.astype(np.float32) for name, values in arrays.items()}


def _arkit(avatar: Avatar) -> ArkitMap | None:
    """None of a head on which no face is found; all else works without."""
    try:
        return avatar.arkit
    except UserError:
        return None


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
    arkit = _arkit(avatar)
    return {
        "format": "rgbavatar-web",
        "version": 1,
        "num_gaussians": avatar.num_gaussians,
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
        "arkit": arkit and {"names": list(ARKIT_NAMES), "turns": arkit.turns},
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


def _assemble(manifest: dict[str, Any], block: bytes, options: PageOptions) -> str:
    """Fill the page's template."""
    scripts = "\n".join(f"<script>\n{source}</script>" for source in sources(PAGE_SCRIPTS))
    packed = base64.b64encode(gzip.compress(block, compresslevel=6, mtime=0)).decode("ascii")
    loopback = [f"{scheme}://{host}:*" for scheme in ("ws", "wss") for host in _LOOPBACK]
    parts = {
        "title": html.escape(options.title),
        "connect": " ".join([*loopback, *options.servers]),
        "style": web_text("style.css"),
        "scripts": scripts,
        "page": _within_script({"origins": options.origins, "servers": options.servers}),
        "manifest": _within_script(manifest),
        "payload": packed,
    }
    # In one pass: what is filled in is not looked at again.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], web_text("page.html"))


def _within_script(content: dict[str, Any]) -> str:
    """JSON for a script element, in which "</script" and "<!--" have a meaning of their own."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")
