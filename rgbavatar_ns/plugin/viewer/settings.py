"""The run's own viewer settings, which hold in `ns-viewer` too."""

import re
from collections.abc import Sequence
from dataclasses import fields, replace

from nerfstudio.configs.base_config import ViewerConfig

_FLAG = re.compile(r"--viewer\.([\w-]+)")
# What one process asks for, which another need not want.
_NOT_KEPT = ("websocket_port", "make_share_url")

_NO_CHUNKS = -1


def is_of_ns_viewer(settings: ViewerConfig) -> bool:
    """Whether they are those that nerfstudio 1.1.5's `ns-viewer` makes of its command line."""
    return settings.num_rays_per_chunk == _NO_CHUNKS


def viewer_settings(
    of_run: ViewerConfig, of_command: ViewerConfig, command_line: Sequence[str]
) -> ViewerConfig:
    """The run's, with what the command line names on top.

    `ns-viewer` brings a full set of its own: by that it would listen on all interfaces, where the
    run was shown to this machine alone.
    """
    named = {flag[1].replace("-", "_") for flag in map(_FLAG.match, command_line) if flag}
    named |= set(_NOT_KEPT)
    of_this = {f.name: getattr(of_command, f.name) for f in fields(of_run) if f.name in named}
    return replace(of_run, **of_this)
