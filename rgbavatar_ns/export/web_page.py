"""The avatar as one HTML file that plays and drives it in any browser, without a server."""

import base64
import html
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.avatar_file import avatar_parts
from rgbavatar_ns.export.web_manifest import avatar_manifest, driving_arrays
from rgbavatar_ns.export.web_scripts import PAGE_SCRIPTS, sources, web_text
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.kernels import PinholeCameras

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
    own_server: bool = False
    """Whether the server that a browser has it from may drive it too."""

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
    It shows a coarse head before it is all there (avatar_file.py). Raises UserError where the file
    cannot be written.
    """
    options = PageOptions() if options is None else options
    manifest = avatar_manifest(
        avatar, camera, theta, seen, options.frames_per_second, options.background
    )
    parts = avatar_parts(avatar, manifest, theta, driving_arrays(avatar, neutral))
    content = _assemble(parts, options).encode()
    with atomic_write(path) as partial:
        partial.write_bytes(content)
    return len(content)


def _check_address(text: str, kind: str, schemes: tuple[str, ...]) -> None:
    """Raise UserError unless the text is an address as the browser writes it."""
    scheme, _, host = text.partition("://")
    if (
        scheme not in schemes
        or not re.fullmatch(_HOST, host)
        or host.endswith(_DEFAULT_PORTS[scheme])
    ):
        raise UserError(
            f"{text!r} is no {kind} of a page.",
            f"Write it as browsers do, in small letters, without a path and without the usual "
            f"port: {schemes[0]}://example.org or {schemes[1]}://localhost:8000.",
        )


def _assemble(parts: list[bytes], options: PageOptions) -> str:
    """Fill the page's template; a script element for each part, after the programs."""
    scripts = "\n".join(f"<script>\n{source}</script>" for source in sources(PAGE_SCRIPTS))
    payload = "\n".join(
        '<script type="application/octet-stream" class="part">'
        f"{base64.b64encode(part).decode('ascii')}</script>"
        for part in parts
    )
    loopback = [f"{scheme}://{host}:*" for scheme in ("ws", "wss") for host in _LOOPBACK]
    page = {
        "origins": options.origins,
        "servers": options.servers,
        "own_server": options.own_server,
    }
    filled = {
        "title": html.escape(options.title),
        "connect": " ".join([*loopback, *options.servers, *["'self'"] * options.own_server]),
        "style": web_text("style.css"),
        "scripts": scripts,
        "page": _within_script(page),
        "parts": payload,
    }
    # In one pass: what is filled in is not looked at again.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: filled[found[1]], web_text("page.html"))


def _within_script(content: dict[str, Any]) -> str:
    """JSON for a script element, in which "</script" and "<!--" have a meaning of their own."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")
