"""Ten minutes on an NVIDIA GPU: whether all works there, how fast, and what does not and why.

    python benchmarks/gpu_check.py --json gpu.json

Run it from a checkout, on Linux. It needs torch, numpy, scipy, cuda-bindings, nvidia-cuda-nvrtc,
jaxtyping and safetensors, neither nerfstudio nor a network, and says what of them is missing. Each
row is printed, and the JSON written anew, as soon as it is there. Each section has a process of its
own and a limit: what hangs or dies is told by name and left behind. The exit status is 1 where a
check failed.
"""

import argparse
import os
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.gpu.child import child  # noqa: E402
from benchmarks.gpu.report import Report  # noqa: E402
from benchmarks.gpu.runner import Runner  # noqa: E402
from benchmarks.gpu.sections import SECTIONS, Section, chosen_sections  # noqa: E402

INTERRUPTED = 130
_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def own_command(section: Section, rows_file: int) -> list[str]:
    """This command, asking one section."""
    return [sys.executable, __file__, "--child", section.name, "--rows-file", str(rows_file)]


def _interrupt(number: int, frame: object) -> None:
    """Once: the process of a section is still to be ended, and what was found to be written."""
    for each in _ENDS:
        signal.signal(each, signal.SIG_IGN)
    raise KeyboardInterrupt


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--json", type=Path, default=Path("gpu_check.json"), help="all figures")
    parser.add_argument("--budget", type=float, default=540.0, help="seconds in all")
    parser.add_argument("--sections", help="only these, separated by commas")
    parser.add_argument("--list", action="store_true", help="say which sections there are")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--rows-file", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    try:
        options.chosen = chosen_sections(options.child or options.sections)
    except ValueError as error:
        parser.error(str(error))
    return options


def checked(options: argparse.Namespace, command: Sequence[str] = ()) -> int:
    """Ask what was chosen."""
    try:
        facts = {"command": [Path(__file__).name, *command], "budget_s": options.budget}
        report = Report(options.json, **facts)
    except OSError as error:
        print(f"{options.json} cannot be written: {error}. Pass --json PATH.", file=sys.stderr)
        return 2
    for number in _ENDS:
        signal.signal(number, _interrupt)
    try:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as cache:
            # Kernels are compiled by the first section, and kept for the others of this check.
            os.environ.setdefault("RGBAVATAR_CACHE", cache)
            Runner(report, own_command, options.budget).run(options.chosen)
    except KeyboardInterrupt:
        print(f"Interrupted; what was found is in {options.json}.")
        return INTERRUPTED
    failed = report.failed()
    whole = "; failed: " + ", ".join(failed) if failed else "; no check failed"
    print(f"All figures are in {options.json}{whole}.")
    return int(bool(failed))


def main(arguments: Sequence[str] | None = None) -> int:
    """List the sections, ask one, or ask all."""
    options = parsed(arguments)
    if options.list:
        for section in SECTIONS:
            print(f"{section.name:12}{section.limit_s:4.0f} s  {section.does}")
        return 0
    if options.child is not None:
        child(options.chosen[0], options.rows_file)
        return 0
    return checked(options, sys.argv[1:] if arguments is None else arguments)


if __name__ == "__main__":
    sys.exit(main())
