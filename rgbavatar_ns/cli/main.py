"""The `rgbavatar` command: finds the sub-command and imports only what that one needs."""

import importlib
import sys
from collections.abc import Sequence

from rgbavatar_ns.errors import UserError

COMMANDS = {
    "demo": "demo subject (or your video) to a trained avatar, its metrics, a film and a picture",
    "demo-data": "render the procedural demo subject as a dataset",
    "track": "turn a video of a head into a dataset",
    "import": "turn other systems' data (INSTA, VHAP, metrical-tracker, ...) into a dataset",
    "check": "look at data before training: what it is, what is odd, and a picture of the fit",
    "render": "films and pictures: held-out frames, another's performance, views, learned bases",
    "export": "the avatar as a bundle, as PLY files of Gaussians or as a web page",
    "sweep": "train and evaluate every cell of an experiment, configs/*.yaml or your own",
    "report": "tables and plots of a sweep",
    "bench": "how fast the rasterizer, a training step and rendering are on this machine",
    "info": "what is installed here and which rasterizer backends can be used",
}
_MODULES = {"import": "import_data"}
"""Of commands whose name cannot be a module's."""


def _help() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {text}" for name, text in COMMANDS.items())
    return (
        f"usage: rgbavatar COMMAND [options]\n\n{rows}\n\n"
        "rgbavatar COMMAND --help shows the options. Training, evaluation and the viewer are\n"
        "nerfstudio's: ns-train rgbavatar, ns-train rgbavatar-tiny, ns-eval, ns-viewer, ns-render."
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one sub-command; a mistake of the user's is told without a traceback (exit code 1)."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    name = arguments[0] if arguments else "--help"
    if name in ("--help", "-h"):
        print(_help())
        return
    if name not in COMMANDS:
        print(f"There is no command {name!r}.\n\n{_help()}", file=sys.stderr)
        sys.exit(2)
    module_name = _MODULES.get(name, name.replace("-", "_"))
    try:
        import tyro

        module = importlib.import_module(f"rgbavatar_ns.cli.{module_name}")
        tyro.cli(module.run, prog=f"rgbavatar {name}", args=arguments[1:])
    except UserError as error:
        print(f"rgbavatar {name}: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print(f"rgbavatar {name}: interrupted; run it again to go on.", file=sys.stderr)
        sys.exit(130)
