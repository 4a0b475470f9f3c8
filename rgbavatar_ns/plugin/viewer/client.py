"""viser's client, sent to browsers so that it keeps the screen's pixels and the newest picture.

viser 0.2.7, which nerfstudio 1.1.5 pins, draws on fewer and fewer pixels where a browser is slow,
down to a fifth a side, and seldom returns; a setting against it came later (`?fixedDpr`, in viser's
pull request 520). One expression of the installed client says so, and is sent changed.

Each picture is decoded by itself, and whichever is ready last was shown: a coarse one that a busy
browser took long for, in place of the sharp one that came after it. Textures are numbered as they
are asked for, so that an older one is told, and dropped.

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
# What takes a decoded picture, or its depths, in the place of the one that is shown.
_TAKES_PLACE = re.compile(
    rb"([\w$]+)=>\{URL\.revokeObjectURL\([\w$]+\);const ([\w$]+)="
    rb"viewer\.backgroundMaterialRef\.current\??\.uniforms\.(?:color|depth)Map\.value;"
)
_UNLESS_OLDER = rb"\g<0>if(\2&&\2.id>\1.id){\1.dispose();return}"
_SCRIPTS = "assets/*.js"
_CALM = (Path(__file__).parent / "calm_client.js").read_bytes()


class SharpClient(PosixPath):
    """viser's built client, or a file of it: a path whose scripts are read as they are sent."""

    def read_bytes(self) -> bytes:
        """The file as browsers get it."""
        plain = super().read_bytes()
        changed, count = _FEWER_PIXELS.subn(_ALL_PIXELS, plain)
        return _CALM + _TAKES_PLACE.sub(_UNLESS_OLDER, changed) if count else plain

    @property
    def known(self) -> bool:
        """Whether this is a client that is changed at the places that are known, and no other."""
        scripts = [Path(script).read_bytes() for script in self.glob(_SCRIPTS)]
        places = ((_FEWER_PIXELS, 1), (_TAKES_PLACE, 2))
        return all(sum(len(p.findall(s)) for s in scripts) == count for p, count in places)


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
