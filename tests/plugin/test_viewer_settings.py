"""ns-viewer shows a run where the run itself was shown: to this machine alone."""

import os
from pathlib import Path

import psutil
import pytest
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.scripts.viewer.run_viewer import ViewerConfigWithoutNumRays

from rgbavatar_ns.plugin.methods import rgbavatar, rgbavatar_tiny
from rgbavatar_ns.plugin.online.methods import rgbavatar_online, rgbavatar_online_tiny
from rgbavatar_ns.plugin.viewer.settings import viewer_settings
from tests.plugin.run import finished_run, small_config
from tests.plugin.viewer_page import started

_METHODS = [rgbavatar, rgbavatar_tiny, rgbavatar_online, rgbavatar_online_tiny]


@pytest.mark.parametrize("method", _METHODS, ids=lambda method: method.config.method_name)
def test_every_method_listens_on_this_machine_alone(method):
    assert method.config.viewer.websocket_host == "127.0.0.1"


def _of_ns_viewer(tmp_path: Path, *command_line: str, **given) -> ViewerConfig:
    config = small_config(tmp_path, tmp_path)
    config.viewer.num_rays_per_chunk, config.viewer.websocket_port = 5, 7010
    command = ViewerConfigWithoutNumRays(**given).as_viewer_config()
    return viewer_settings(config.viewer, command, command_line)


def test_the_runs_settings_hold_where_the_command_names_none(tmp_path: Path):
    held = _of_ns_viewer(tmp_path, "--load-config", "c.yml")
    assert (held.websocket_host, held.max_num_display_images) == ("127.0.0.1", 1)
    assert held.websocket_port is None  # that of another process
    assert not held.default_composite_depth


@pytest.mark.parametrize(
    "flag", [["--viewer.websocket-host", "0.0.0.0"], ["--viewer.websocket_host=0.0.0.0"]]
)
def test_what_the_command_names_comes_first(tmp_path: Path, flag: list[str]):
    held = _of_ns_viewer(tmp_path, *flag, websocket_host="0.0.0.0")
    assert (held.websocket_host, held.max_num_display_images) == ("0.0.0.0", 1)


def test_a_program_may_set_what_it_likes(tmp_path: Path):
    config = small_config(tmp_path, tmp_path)
    config.viewer = ViewerConfig(websocket_host="::1")
    assert config.viewer.websocket_host == "::1"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "address"),
    [
        ([], "127.0.0.1"),
        pytest.param(["--viewer.websocket-host", "0.0.0.0"], "0.0.0.0", marks=pytest.mark.nightly),
    ],
)
def test_ns_viewer_listens_on_this_machine_alone_unless_told(
    tiny_data: Path, tmp_path: Path, flags: list[str], address: str
):
    config = finished_run(tiny_data, tmp_path, max_num_iterations=2)
    command = ["ns-viewer", "--load-config", str(config), *flags]
    assert _listening(command, tmp_path / "log") == {address}


def _listening(command: list[str], log: Path) -> set[str]:
    """The addresses on which a command's viewer waits for browsers."""
    with started(command, log):
        mine = psutil.Process(os.getpid()).children(recursive=True)
        return {
            c.laddr.ip
            for process in mine
            for c in process.net_connections()
            if c.status == "LISTEN"
        }
