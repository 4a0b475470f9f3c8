"""Where the time goes on a long film, how much memory it takes, and what grows with its length.

    python benchmarks/speed/long_film.py --frames 250 1000 5000 --folder /tmp/long --json long.json

A procedural film of the longest length is made once in the folder; then each length is tracked,
trained (tiny and full size, a few hundred steps) and evaluated, each as a process of its own whose
resident memory is looked at twenty times a second, its children's included. CPU seconds are of all
its threads: on a machine that others use they tell what the clock does not. What lies in the folder
is not made again, so that an interrupted run goes on, unless other options change it; datasets stay
for another look.
"""

import argparse
import json
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from procedural_film import film_config, write_film
from rich.console import Console
from rich.table import Table
from stage_times import StageTimes
from watched_process import Watched, watch

from rgbavatar_ns.files import Stages, write_json
from rgbavatar_ns.tracking import TrackConfig, track_video
from rgbavatar_ns.tracking.face.detector import load_mediapipe

_STAGE_TIMES = "stage_times.json"
_PRESETS = {"tiny": "rgbavatar-tiny", "full": "rgbavatar"}
_LOADING, _END = "loading", "after the last stage"


@dataclass(frozen=True)
class Costs:
    """What one stage took. `silent_s`: the longest time without progress, where that is told."""

    clock_s: float
    cpu_s: float | None
    peak_mib: float
    silent_s: float | None = None


def tracked_alone(video: Path, dataset: Path, frames: int, size_px: int, times: Path) -> None:
    """Track in this process, and write what each stage took."""
    costs = StageTimes()
    load_mediapipe()
    costs(_LOADING, 0, None)
    track_video(
        video, dataset, TrackConfig(image_size=size_px, max_frames=frames, overwrite=True), costs
    )
    costs(_END, frames, frames)
    told = {name: part for name, part in asdict(costs).items() if not name.startswith("_")}
    write_json(times, told)


def tracking(video: Path, folder: Path, frames: int, size_px: int) -> dict[str, Costs]:
    """`rgbavatar track`, by stage."""
    times = folder / _STAGE_TIMES
    words = ["python", __file__, "--folder", str(folder), "--frames", str(frames)]
    words += ["--size", str(size_px), "--track-alone", str(video)]
    watched = watch(words, folder / "track.log")
    told = json.loads(times.read_text())
    found = {}
    for stage, (began, ended) in told["span_s"].items():
        peak = watched.memory.peak_mib(began, ended)
        clock, cpu, silent = (told[name][stage] for name in ("clock_s", "cpu_s", "silent_s"))
        found[f"track: {stage}"] = Costs(clock, cpu, peak, silent)
    return found | {"track": _whole(watched)}


def training(dataset: Path, folder: Path, size: str, steps: int) -> dict[str, Costs]:
    """`ns-train`, and how long it took to the first step and from the last one on."""
    runs = folder / "runs"
    shutil.rmtree(runs / size, ignore_errors=True)
    words = ["ns-train", _PRESETS[size], "--data", str(dataset), "--output-dir", str(runs)]
    words += ["--experiment-name", size, "--timestamp", "run", "--vis", "tensorboard"]
    watched = watch([*words, "--max-num-iterations", str(steps)], folder / f"train_{size}.log")
    run = _run(folder, size)
    # The last file that is written before the first step.
    first_s = (run / "dataparser_transforms.json").stat().st_mtime - time.time()
    first_s += time.monotonic() - watched.began_s
    summary = json.loads((run / "training.json").read_text())
    steps_s, edge = float(summary["train_seconds"]), watched.began_s + first_s
    before = Costs(first_s, None, watched.memory.peak_mib(ended_s=edge))
    taken = Costs(steps_s, None, watched.memory.peak_mib(edge, edge + steps_s))
    name = f"train {size}"
    return {
        f"{name}: until the first step": before,
        f"{name}: {steps} steps": taken,
        name: _whole(watched),
    }


def evaluation(folder: Path, size: str) -> dict[str, Costs]:
    """`ns-eval`."""
    words = ["ns-eval", "--load-config", str(_run(folder, size) / "config.yml")]
    words += ["--output-path", str(folder / f"eval_{size}.json")]
    return {f"eval {size}": _whole(watch(words, folder / f"eval_{size}.log"))}


def _whole(watched: Watched) -> Costs:
    return Costs(watched.clock_s, watched.cpu_s, watched.memory.peak_mib())


def _run(folder: Path, size: str) -> Path:
    return folder / "runs" / size / _PRESETS[size] / "run"


def measured(
    video: Path, folder: Path, frames: int, size_px: int, steps: Mapping[str, int]
) -> dict[str, Costs]:
    """All of one length; what an earlier call has measured of the same is read."""
    own = folder / f"{frames}"
    own.mkdir(parents=True, exist_ok=True)
    stages, found = Stages(own, [video.name, size_px]), {}

    def measure(name: str, made_from: Any, work: Callable[[], dict[str, Costs]]) -> None:
        told = stages.run(
            name, made_from, lambda key: {row: asdict(costs) for row, costs in work().items()}
        )
        found.update({row: Costs(**costs) for row, costs in told.items()})

    measure("track", None, lambda: tracking(video, own, frames, size_px))
    for size, count in steps.items():
        measure(f"train {size}", count, partial(training, own / "dataset", own, size, count))
        measure(f"eval {size}", None, partial(evaluation, own, size))
    return found


def table(costs: Mapping[int, Mapping[str, Costs]]) -> Table:
    """A row a stage, four columns a length."""
    shown = Table("stage", box=None)
    for frames in costs:
        for column in (f"{frames}: s", "CPU s", "MiB", "silent s"):
            shown.add_column(column, justify="right")
    for stage in dict.fromkeys(name for found in costs.values() for name in found):
        row = [stage]
        for found in costs.values():
            one = found.get(stage)
            if one is None:
                row += [""] * 4
                continue
            row += [_text(one.clock_s), _text(one.cpu_s), f"{one.peak_mib:.0f}"]
            row.append(_text(one.silent_s))
        shown.add_row(*row)
    return shown


def _text(seconds: float | None) -> str:
    return "" if seconds is None else f"{seconds:.1f}"


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, required=True, help="film, datasets and runs")
    parser.add_argument("--frames", type=int, nargs="+", default=[250, 1000, 5000])
    parser.add_argument("--size", type=int, default=512, help="pixels of the film")
    parser.add_argument("--tiny-steps", type=int, default=300)
    parser.add_argument("--full-steps", type=int, default=200)
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--track-alone", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    folder: Path = given.folder
    if given.track_alone is not None:
        (frames,) = given.frames
        times = folder / _STAGE_TIMES
        tracked_alone(given.track_alone, folder / "dataset", frames, given.size, times)
        sys.exit(0)
    folder.mkdir(parents=True, exist_ok=True)
    film = folder / f"film_{max(given.frames)}_{given.size}.mp4"
    if not film.exists():
        write_film(film, film_config(max(given.frames), given.size))
    steps = {"tiny": given.tiny_steps, "full": given.full_steps}
    costs = {frames: measured(film, folder, frames, given.size, steps) for frames in given.frames}
    if given.json is not None:
        told = {k: {name: asdict(one) for name, one in v.items()} for k, v in costs.items()}
        write_json(given.json, {str(frames): found for frames, found in told.items()})
    Console(width=40 + 40 * len(costs)).print(table(costs))


if __name__ == "__main__":
    main()
