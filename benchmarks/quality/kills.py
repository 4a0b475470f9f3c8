"""Whether what was killed goes on as if nothing had happened: kill -9 at random moments.

    python benchmarks/quality/kills.py --kills 100 --seed 0 --json kills.json

Each kind of work is done once undisturbed, then again and again with one to three kills at random
moments, each followed by the same command (`ns-train` with --load-dir, as it says). In the end the
results must be the same bytes, tensors or figures, no process may live on, and no file may be left
that the undisturbed work does not leave. A stream does not wait, so of an online run the resumed
end is compared in kind: it is finished, and its training.json says so. Exit code 1 tells of a
difference; `--only KIND ...` chooses kinds; tracking takes part with `--film VIDEO`.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from rgbavatar_ns.files import digest, write_json

_BIN = Path(sys.executable).parent
_TINY = ("--pipeline.model.avatar.uv-resolution", "32", "--pipeline.model.avatar.num-bases", "4")
_GOES_ON_S = 90.0
"""How long a process may take to save and end after its parent was killed."""
_TEMPORARY = (".partial", ".old", ".unfinished", ".tracking", ".tmp")
_SWEEP = """
title: kills
preset: rgbavatar-tiny
subjects: [{data}]
seeds: [0]
base:
  max_num_iterations: 30
  steps_per_save: 5
  pipeline.model.avatar.uv_resolution: 32
variants:
  - name: few
    set: {{pipeline.model.avatar.num_bases: 4}}
"""


@dataclass(frozen=True)
class Work:
    """A command, and what it makes in the folder that it runs in."""

    command: Callable[[Path], list[str]]
    result: Callable[[Path], Any]


@dataclass
class Outcome:
    """What came of a kind of work."""

    kills: int = 0
    rounds: int = 0
    seconds: float = 0.0
    faults: list[str] = field(default_factory=list)


def files_of(folder: Path, without: tuple[str, ...] = ()) -> dict[str, str]:
    """Digest by path of all files but those of these names."""
    return {
        str(path.relative_to(folder)): digest([path.read_bytes()])[:16]
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in without
    }


def newest_checkpoint(folder: Path) -> Any:
    """Digest of all tensors of the newest checkpoint below a folder, and its step."""
    path = max(folder.rglob("step-*.ckpt"))
    state = torch.load(path, map_location="cpu", weights_only=True)
    state.pop("train_seconds")
    return path.name, digest(_tensors(state))[:16]


def _tensors(value: Any) -> list[Any]:
    if isinstance(value, torch.Tensor):
        return [value.detach().numpy()]
    if isinstance(value, dict):
        return [part for key in sorted(value, key=str) for part in _tensors(value[key])]
    if isinstance(value, list | tuple):
        return [part for item in value for part in _tensors(item)]
    return [repr(value)]


def train(method: str, data: Path, *more: str) -> Callable[[Path], list[str]]:
    """`ns-train`, which resumes where there is a checkpoint."""

    def command(folder: Path) -> list[str]:
        run = folder / "kills" / method / "run"
        words = ["ns-train", method, "--data", str(data), "--output-dir", str(folder)]
        words += ["--experiment-name", "kills", "--timestamp", "run", "--vis", "tensorboard"]
        words += [*_TINY, *more]
        if any(run.glob("nerfstudio_models/step-*.ckpt")):
            words += ["--load-dir", str(run / "nerfstudio_models")]
        return words

    return command


def ended_online(folder: Path) -> Any:
    """What every finished online run says alike."""
    (summary,) = folder.rglob("training.json")
    told = json.loads(summary.read_text())
    return {"has steps": told["steps"] > 0, "checkpoint": any(folder.rglob("step-*.ckpt"))}


def sweep_scores(folder: Path) -> Any:
    """The cell's scores."""
    (result,) = folder.rglob("result.json")
    return {name: json.loads(result.read_text())["metrics"][name] for name in ("psnr", "ssim")}


def kinds(folder: Path, film: Path | None) -> dict[str, Work]:
    """The work, on a small subject that is made in `folder`."""
    data, insta, bundle = folder / "data", folder / "insta", folder / "me"
    few = ["--num-frames", "24", "--num-test-frames", "4", "--image-size", "64"]
    run(["rgbavatar", "demo-data", str(data), *few])
    run(["rgbavatar", "demo-data", str(insta), *few, "--format", "insta"])
    (flame,) = folder.rglob("insta/**/*.pkl")
    run(train("rgbavatar-tiny", data, "--max-num-iterations", "5")(folder / "first"))
    run(["rgbavatar", "export", str(folder / "first/kills/rgbavatar-tiny/run"), str(bundle)])
    (folder / "kills.yaml").write_text(_SWEEP.format(data=data))
    small = ("--max-frames", "24", "--image-size", "64")
    often = ("--max-num-iterations", "40", "--steps-per-save", "5", "--machine.seed", "0")
    made = {
        "train": Work(train("rgbavatar-tiny", data, *often), newest_checkpoint),
        "refine": Work(
            train("rgbavatar-tiny", data, *often, "--pipeline.model.refine-tracking", "True"),
            newest_checkpoint,
        ),
        "online": Work(
            train("rgbavatar-online-tiny", data, "--steps-after-stream", "20", *often[2:]),
            ended_online,
        ),
        "import": Work(
            lambda at: ["rgbavatar", "import", str(insta), str(at / "set"), "--flame", str(flame)],
            files_of,
        ),
        "demo-data": Work(lambda at: ["rgbavatar", "demo-data", str(at / "set"), *few], files_of),
        "export": Work(
            lambda at: ["rgbavatar", "export", str(bundle), str(at / "a.html"), "--format", "web"],
            files_of,
        ),
        "bundle": Work(
            lambda at: ["rgbavatar", "export", str(bundle), str(at / "out/me")], files_of
        ),
        "sweep": Work(
            lambda at: ["rgbavatar", "sweep", str(folder / "kills.yaml"), "--output", str(at)],
            sweep_scores,
        ),
    }
    if film is not None:
        made["track"] = Work(
            lambda at: ["rgbavatar", "track", str(film.resolve()), str(at / "set"), *small],
            lambda at: files_of(at, without=("tracking.json",)),
        )
    return made


def start(words: list[str]) -> "subprocess.Popen[bytes]":
    """A command of this environment, its output out of sight."""
    return subprocess.Popen(
        [str(_BIN / words[0]), *words[1:]],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def run(words: list[str]) -> None:
    """A command that must succeed; exits with what it says where it does not."""
    process = start(words)
    told = process.communicate()[1].decode(errors="replace")
    if process.returncode:
        sys.exit(f"{' '.join(words)} ended with {process.returncode}: {told[-800:]}")


def alive(folder: Path) -> list[str]:
    """Processes whose command names the folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if str(folder) in words and str(os.getpid()) != path.parent.name:
            found.append(words[:150])
    return found


def disturb(work: Work, folder: Path, whole_s: float, chance: random.Random) -> tuple[int, str]:
    """Do the work with one to three kills; how many there were, and the fault, if any."""
    kills = 0
    for _ in range(chance.randint(1, 3)):
        process = start(work.command(folder))
        try:
            process.wait(chance.uniform(0.02, 1.0) * whole_s)
            break
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
        until = time.monotonic() + _GOES_ON_S
        while alive(folder) and time.monotonic() < until:
            time.sleep(0.1)
        if alive(folder):
            return kills, f"lives on: {alive(folder)[0]}"
    process = start(work.command(folder))
    told = process.communicate()[1].decode(errors="replace")
    if process.returncode and "is not empty" not in told:
        return kills, f"ended with {process.returncode}: {told[-300:]}"
    return kills, ""


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--film", type=Path)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    chance = random.Random(given.seed)
    outcomes: dict[str, Outcome] = {}
    with tempfile.TemporaryDirectory() as name:
        work = kinds(Path(name), given.film)
        chosen = given.only or list(work)
        for kind in chosen:
            outcome = outcomes[kind] = Outcome()
            undisturbed = Path(name) / kind / "whole"
            undisturbed.mkdir(parents=True)
            began = time.monotonic()
            run(work[kind].command(undisturbed))
            outcome.seconds = time.monotonic() - began
            wanted = work[kind].result(undisturbed)
            while outcome.kills < given.kills / len(chosen):
                place = Path(name) / kind / f"round{outcome.rounds}"
                place.mkdir()
                kills, fault = disturb(work[kind], place, outcome.seconds, chance)
                outcome.kills += kills
                outcome.rounds += 1
                if not fault and work[kind].result(place) != wanted:
                    fault = "another result"
                left = [p.name for p in place.rglob(".*") if any(t in p.name for t in _TEMPORARY)]
                if not fault and left:
                    fault = f"leaves {left}"
                if fault:
                    outcome.faults.append(fault)
            print(
                f"{kind:<10} {outcome.kills:>4} kills, {outcome.rounds:>3} rounds of "
                f"{outcome.seconds:.0f} s, {len(outcome.faults)} faults {outcome.faults[:3]}",
                flush=True,
            )
    if given.json is not None:
        write_json(given.json, {kind: vars(outcome) for kind, outcome in outcomes.items()})
    sys.exit(any(outcome.faults for outcome in outcomes.values()))


if __name__ == "__main__":
    main()
