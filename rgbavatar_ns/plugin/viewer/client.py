"""viser's client, sent to browsers so that its canvas keeps the screen's pixels.

viser 0.2.7, which nerfstudio 1.1.5 pins, draws on fewer and fewer pixels where a browser is slow,
down to a fifth a side, and seldom returns; a setting against it came later (`?fixedDpr`, in viser's
pull request 520). One expression of the installed client says so, and is sent changed.

It also draws without end where nothing changes: without a graphics card, most of a core that
training needs. Before it stands a script by which it draws a few times a second until something
happens.
"""

import re
from pathlib import Path, PosixPath
from typing import Any

from viser import infra

from rgbavatar_ns.plugin.console import say

_FEWER_PIXELS = re.compile(rb"window\.devicePixelRatio\*\(\.2\+\.8\*[\w$]+\)")
# Beyond two pixels a point nothing is won; three.js's canvas begins with this, too.
_ALL_PIXELS = b"Math.min(window.devicePixelRatio,2)"
_SCRIPTS = "assets/*.js"
_CALM = (Path(__file__).parent / "calm_client.js").read_bytes()


class SharpClient(PosixPath):
    """viser's built client, or a file of it: a path whose scripts are read with all pixels."""

    def read_bytes(self) -> bytes:
        """The file as browsers get it."""
        plain = super().read_bytes()
        changed, count = _FEWER_PIXELS.subn(_ALL_PIXELS, plain)
        return _CALM + changed if count else plain

    @property
    def known(self) -> bool:
        """Whether this is a client that draws on fewer pixels, at the one place that is known."""
        scripts = (Path(script).read_bytes() for script in self.glob(_SCRIPTS))
        return sum(len(_FEWER_PIXELS.findall(script)) for script in scripts) == 1


class _SharpServer(infra.WebsockServer):
    def __init__(self, *arguments: Any, http_server_root: Path | None = None, **more: Any) -> None:
        if http_server_root is not None:
            client = SharpClient(http_server_root)
            if client.known:
                http_server_root = client
            else:
                say("Another viser than 0.2.7: in a slow browser its pictures may stay coarse.")
        super().__init__(*arguments, http_server_root=http_server_root, **more)


def serve_sharp_client() -> None:
    """Let all viser servers of this process, from now on, send the client with all pixels.

    viser has no setting for what it sends. Where the client is another than is known, it is sent
    as it is, and a line says so.
    """
    infra.WebsockServer = _SharpServer
