"""Whether `ns-train rgbavatar-online-tiny` keeps up with a stream while a viewer looks on.

    python benchmarks/speed/online_realtime.py --seconds 120 --browser

Replays a demo subject in real time through the command itself and prints what it told at its end:
frames that arrived and were dropped, the median time from a frame's arrival to its first use in a
batch, images a second. With `--browser` a headless Chromium holds the viewer open meanwhile
(playwright and chromium are needed; RGBAVATAR_CHROMIUM names another). On two cores the tiny
preset is meant to take in every frame of 25 a second, with a median below half a second.
"""

import argparse
import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import Progress

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset

FRAMES_PER_SECOND = 25.0
MOST_LATENCY_S = 0.5
_FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def subject(seconds: float, image_size: int, folder: Path) -> Path:
    """A demo subject of that length, made where it is not there."""
    frames = max(2, round(seconds * FRAMES_PER_SECOND))
    place = folder / f"{image_size}_{frames}"
    if not (place / "dataset.json").exists():
        config = DemoConfig(
            image_size=image_size,
            num_frames=frames + 20,
            num_test_frames=20,
            frames_per_second=FRAMES_PER_SECOND,
        )
        with Progress() as progress:
            bar = progress.add_task("subject", total=config.num_frames)
            make_demo_dataset(
                place, config, lambda done, total: progress.update(bar, completed=done)
            )
    return place


@contextlib.contextmanager
def browser(address: str) -> Iterator[None]:
    """A page of the viewer, open for as long as the context."""
    from playwright.sync_api import sync_playwright

    program = os.environ.get("RGBAVATAR_CHROMIUM") or shutil.which("chromium")
    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=program, args=_FLAGS)
        chromium.new_page(viewport={"width": 1000, "height": 800}).goto(address)
        yield
        chromium.close()


def viewer_address(process: "subprocess.Popen[bytes]", log: Path) -> str:
    """Where the command says that its viewer is."""
    while process.poll() is None:
        found = re.search(r"http://[\d.]+:\d+", log.read_text())
        if found:
            return found.group(0)
        time.sleep(0.1)
    raise SystemExit(log.read_text())


def run(data: Path, arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """One run of the command; what it wrote about itself."""
    log = folder / "log.txt"
    command = [str(Path(sys.executable).with_name("ns-train")), arguments.method]
    command += ["--data", str(data), "--output-dir", str(folder), "--timestamp", "run"]
    command += ["--viewer.quit-on-train-completion", "True", "--steps-after-stream", "20"]
    command += arguments.more
    with log.open("w") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        looking = contextlib.nullcontext()
        try:
            if arguments.browser:
                looking = browser(viewer_address(process, log))
            with looking:
                if process.wait() != 0:
                    raise SystemExit(log.read_text())
        finally:  # without the browser there is nothing to train for
            process.terminate()
            process.wait()
    (summary,) = folder.glob("*/*/run/training.json")
    told: dict[str, Any] = json.loads(summary.read_text())
    held_out = load_dataset(data)
    told["seconds"] = len(held_out.train) / FRAMES_PER_SECOND
    return told


def main() -> None:
    """Run and print; the exit code says whether it kept up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--image-size", type=int, default=256)
    parser.add_argument("--method", default="rgbavatar-online-tiny")
    parser.add_argument("--browser", action="store_true", help="hold the viewer open meanwhile")
    parser.add_argument("--subjects", type=Path, help="keep the subjects here")
    parser.add_argument("--more", nargs=argparse.REMAINDER, default=[], help="flags of ns-train")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data = subject(arguments.seconds, arguments.image_size, arguments.subjects or Path(folder))
        told = run(data, arguments, Path(folder))
    # Without a frame that was drawn there is no latency.
    stream, latency_s = told["stream"], told.get("median_latency_s", float("inf"))
    kept_up = stream["dropped"] == 0 and latency_s < MOST_LATENCY_S
    Console().print(
        f"{told['seconds']:.0f} s at {FRAMES_PER_SECOND:.0f} frames/s on {torch.get_num_threads()} "
        f"threads: {stream['arrived']} frames arrived, {stream['dropped']} dropped, "
        f"median latency {latency_s:.3f} s, {told['images_per_second']:.0f} images/s, "
        f"{told['steps']} steps: {'kept up' if kept_up else 'did not keep up'}.",
        highlight=False,
    )
    raise SystemExit(0 if kept_up else 1)


if __name__ == "__main__":
    main()
