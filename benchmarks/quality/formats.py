"""Whether training on another system's format reaches what the project's own format reaches.

    python benchmarks/quality/formats.py --json formats.json

The demo subject is filmed as `rgbavatar demo-data --format X` films it and written in that format
and in the project's own: the same images, the same head (a FLAME-shaped pickle that holds nothing
of FLAME) and the same held-out frames. What `ns-train rgbavatar-tiny --data` does is done on each
with the same seeds, in this one process, which spares a minute of imports a training; then the
held-out frames are scored. A format that films as no other does (a stiff neck, another version of
FLAME) has a twin in the project's own format with the same film. The exit code is 1 where a
format's mean over the seeds is more than .2 dB from its twin's.
"""

import argparse
import copy
import dataclasses
import json
import os
import statistics
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils import writer
from rich.progress import Progress

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.head.flame import FLAME_VARIABLE
from rgbavatar_ns.plugin.methods import rgbavatar_tiny
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.exporters import DEMO_FORMATS, FLAME_FOLDER, FlameFilm, NativeWriter

WITHIN_DB = 0.2


@dataclass(frozen=True)
class Row:
    """A format's held-out PSNR by seed, in dB, and its twin's."""

    format: str
    psnr: tuple[float, ...]
    native: tuple[float, ...]

    @property
    def difference(self) -> float:
        """Of the means over seeds, in dB; negative where the format is worse."""
        return statistics.fmean(self.psnr) - statistics.fmean(self.native)

    @property
    def within(self) -> bool:
        """Whether the format reaches the project's own."""
        return abs(self.difference) <= WITHIN_DB


def film_of(name: str) -> str:
    """The name of the native twin: formats that film alike share it."""
    chosen = DEMO_FORMATS[name]
    return f"native-{chosen.version}-{'stiff' if chosen.stiff_neck else 'neck'}"


def write_data(root: Path, formats: Iterable[str], config: DemoConfig) -> dict[str, Path]:
    """Write every format and its twin; folders by name. Each film is rendered once."""
    folders: dict[str, Path] = {}
    twins: dict[str, list[str]] = {}
    for name in formats:
        twins.setdefault(film_of(name), []).append(name)
    with Progress() as progress:
        for twin, names in twins.items():
            chosen = DEMO_FORMATS[names[0]]
            film = FlameFilm(root, config, chosen.version, chosen.stiff_neck, names[0])
            folders |= {name: root / "data" / name for name in (twin, *names)}
            writers = [NativeWriter(folders[twin], film.take)]
            writers += [DEMO_FORMATS[name].writer(folders[name], film.take) for name in names]
            bar = progress.add_task(f"filming {', '.join(names)}", total=config.num_frames)
            for frame in film.frames():
                for writer in writers:
                    writer.add(frame)
                progress.advance(bar)
            for writer in writers:
                writer.finish()
    return folders


def require_same_split(folders: dict[str, Path]) -> None:
    """Import all; RuntimeError where a format holds out other frames than its twin."""
    for name in folders.keys() & DEMO_FORMATS.keys():
        own, twin = (load_dataset(folders[which]) for which in (name, film_of(name)))
        if own.frame_index != twin.frame_index or own.test != twin.test:
            raise RuntimeError(f"{name} does not hold out the frames that its twin does.")


def train(root: Path, folders: dict[str, Path], arguments: argparse.Namespace) -> dict[str, Any]:
    """Train and score each folder with each seed; held-out metrics by "name/seed"."""
    scores: dict[str, Any] = {}
    for name, folder in folders.items():
        for seed in arguments.seeds:
            key = f"{name}/{seed}"
            print(key, file=sys.stderr)
            trainer = set_up(configured(root / "runs" / key, folder, seed, arguments))
            trainer.train()
            found = trainer.pipeline.get_average_eval_image_metrics(step=arguments.steps)
            scores[key] = {metric: float(value) for metric, value in found.items()}
    return scores


def configured(
    output: Path, data: Path, seed: int, arguments: argparse.Namespace
) -> RGBAvatarTrainerConfig:
    """The preset as ns-train's flags would set it."""
    config = copy.deepcopy(rgbavatar_tiny.config)
    assert isinstance(config, RGBAvatarTrainerConfig)
    config.output_dir, config.experiment_name, config.timestamp = output, "formats", "run"
    config.data, config.machine.seed, config.vis = data, seed, "tensorboard"
    config.max_num_iterations = config.learning_rate_steps = arguments.steps
    # The last checkpoint alone; no scores on the way.
    config.steps_per_save = config.steps_per_eval_batch = arguments.steps
    config.steps_per_eval_image = config.steps_per_eval_all_images = 10 * arguments.steps
    if arguments.head_pose is not None:
        importing = config.pipeline.datamanager.dataparser.importing
        changed = dataclasses.replace(importing, head_pose=arguments.head_pose)
        config.pipeline.datamanager.dataparser.importing = changed
    config.pipeline.datamanager.data = data
    return config


def set_up(config: RGBAvatarTrainerConfig) -> RGBAvatarTrainer:
    """What ns-train does up to the first step."""
    # nerfstudio keeps its writers for good.
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    _set_random_seed(config.machine.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def rows_of(metrics: dict[str, Any], formats: Iterable[str], seeds: list[int]) -> Iterator[Row]:
    """What the table shows."""
    for name in formats:
        own, twin = (
            tuple(metrics[f"{which}/{seed}"]["psnr"] for seed in seeds)
            for which in (name, film_of(name))
        )
        yield Row(name, own, twin)


def tell(rows: list[Row]) -> None:
    """Print the table."""
    print(f"{'held-out PSNR, dB':<20}{'format':>8}{'native':>8}{'apart':>8}   by seed")
    for row in rows:
        means = (statistics.fmean(values) for values in (row.psnr, row.native))
        by_seed = ", ".join(f"{a - b:+.2f}" for a, b in zip(row.psnr, row.native))
        cells = "".join(f"{mean:>8.2f}" for mean in means)
        verdict = "" if row.within else f"   NOT within {WITHIN_DB}"
        print(f"{row.format:<20}{cells}{row.difference:>+8.2f}   {by_seed}{verdict}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=120, help="a quarter of them is held out")
    parser.add_argument("--size", type=int, default=128, help="of the images in pixels")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--formats", nargs="+", choices=DEMO_FORMATS, default=list(DEMO_FORMATS))
    parser.add_argument("--head-pose", help="where importers put the head's motion")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    arguments = parser.parse_args()
    config = DemoConfig(
        image_size=arguments.size,
        num_frames=arguments.frames,
        num_test_frames=arguments.frames // 4,
    )
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        os.environ[FLAME_VARIABLE] = str(root / FLAME_FOLDER)
        folders = write_data(root, arguments.formats, config)
        require_same_split(folders)
        metrics = train(root, folders, arguments)
    rows = list(rows_of(metrics, arguments.formats, arguments.seeds))
    tell(rows)
    if arguments.json:
        settings = {name: str(value) for name, value in vars(arguments).items()}
        arguments.json.write_text(json.dumps({"settings": settings, "runs": metrics}, indent=2))
    sys.exit(0 if all(row.within for row in rows) else 1)


if __name__ == "__main__":
    main()
