"""The installed viser's client is the one whose pixels are known to be kept."""

import re
import shutil
import urllib.request
from pathlib import Path

import pytest
import viser
from viser import infra

from rgbavatar_ns.plugin.viewer import client
from rgbavatar_ns.plugin.viewer.client import SharpClient, serve_sharp_client

_BUILD = Path(viser.__file__).parent / "client" / "build"


@pytest.fixture
def sharp_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(infra, "WebsockServer", infra.WebsockServer)
    serve_sharp_client()


def _served(*paths: str) -> list[bytes]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        host, port = server._websock_server._ws_server.sockets[0].getsockname()
        # urllib's own opener keeps the proxy of whichever test asked first.
        direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        return [direct.open(f"http://{host}:{port}/{path}").read() for path in paths]
    finally:
        server.stop()


@pytest.mark.usefixtures("sharp_servers")
def test_browsers_get_the_installed_client_with_three_expressions_changed():
    (script,) = (path for path in _BUILD.glob("assets/*.js") if b"Setting DPR" in path.read_bytes())
    served, index = _served(script.relative_to(_BUILD).as_posix(), "index.html")
    plain = script.read_bytes()
    assert b"Setting DPR" in served
    calm = (Path(client.__file__).parent / "calm_client.js").read_bytes()
    assert served.startswith(calm)
    served, dropped = re.subn(
        rb"if\(([\w$]+)&&\1\.id>([\w$]+)\.id\)\{\2\.dispose\(\);return\}", b"", served[len(calm) :]
    )
    assert dropped == 2, "of pictures and of their depths"
    same = next(i for i, pair in enumerate(zip(served, plain)) if pair[0] != pair[1])
    assert plain[same - 30 : same + 60].count(b"window.devicePixelRatio*(.2+.8*") == 1
    changed = b"Math.min(window.devicePixelRatio,2)"
    assert served.count(changed) == 1
    # All after it is as it was.
    rest = served.partition(changed)[2]
    assert plain.endswith(rest)
    assert len(plain) - len(rest) - same < 60
    assert index == (_BUILD / "index.html").read_bytes()


@pytest.mark.parametrize("times", [0, 2])
def test_an_unknown_client_is_sent_as_it_is_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sharp_servers: None, times: int
):
    shutil.copytree(_BUILD, tmp_path / "build")
    expression = b"window.devicePixelRatio*(.2+.8*x)"
    for script in tmp_path.glob("build/assets/*.js"):
        script.write_bytes(b"")
    script.write_bytes(expression * times)
    assert not SharpClient(tmp_path / "build").known
    server = infra.WebsockServer("127.0.0.1", 0, http_server_root=tmp_path / "build")
    assert server._http_server_root == tmp_path / "build"
    assert not isinstance(server._http_server_root, SharpClient)
    assert "may stay coarse" in capsys.readouterr().out


def test_the_installed_client_is_known(capsys: pytest.CaptureFixture[str], sharp_servers: None):
    assert SharpClient(_BUILD).known
    server = infra.WebsockServer("127.0.0.1", 0, http_server_root=_BUILD)
    assert isinstance(server._http_server_root, SharpClient)
    assert "coarse" not in capsys.readouterr().out
