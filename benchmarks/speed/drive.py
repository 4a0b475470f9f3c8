"""How late and how often a driven avatar is drawn, and whether anything grows meanwhile.

    python benchmarks/speed/drive.py RUN VIDEO [VIDEO ...] [--minutes 10]

The videos are played to and fro into one film of 25 frames a second, which is then performed in
real time: picture, face, head, transfer, drawing at 512 x 512. Printed each half minute, and at
the end: pictures a second, median and 95 % latency from the moment a frame was due to its drawn
picture, all of the last two minutes; of the whole drive what was drawn and skipped, the memory
after a minute, at the end and at most. First, with the frames of the run itself, what transfer and
drawing take alone.
"""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import psutil
import tyro

from rgbavatar_ns.driving.live_drive import DrivenFrame, LiveDrive
from rgbavatar_ns.driving.live_transfer import LiveTransfer
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.errors import told_without_traceback
from rgbavatar_ns.export import FilmWriter
from rgbavatar_ns.export.live_pictures import PictureOutput
from rgbavatar_ns.export.subject import Subject, load_subject
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.performer import FilmedPerformer

_RATE = 25
_TOLD_EVERY_S = 30.0


class _Nowhere:
    def add(self, picture: np.ndarray, time_s: float) -> None:
        """Drop it: it has been drawn."""

    def close(self) -> None:
        """Nothing was begun."""


def main(
    run: Annotated[Path, tyro.conf.Positional],
    videos: Annotated[list[Path], tyro.conf.Positional],
    minutes: float = 1.0,
    size: int = 512,
) -> None:
    """Perform the videos for so many minutes."""
    subject = load_subject(run, None, size, size)
    _without_camera(subject)
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        with FilmWriter(film, float(_RATE)) as writer:
            for image in _to_and_fro(videos, round(60 * minutes * _RATE)):
                writer.add(image)
        performer = FilmedPerformer(str(film))
        transfer = LiveTransfer(subject.avatar, subject.seen, performer.head, subject.camera)
        output = PictureOutput(subject.avatar, subject.camera, (1.0, 1.0, 1.0), _Nowhere())
        memory_mb: list[tuple[float, float]] = []
        began_s = told_s = time.monotonic()

        def tell(line: str) -> None:
            nonlocal told_s
            now_s = time.monotonic()
            memory_mb.append((now_s - began_s, psutil.Process().memory_info().rss / 1e6))
            if now_s - told_s > _TOLD_EVERY_S:
                told_s = now_s
                print(f"{now_s - began_s:5.0f} s  {line}  {memory_mb[-1][1]:.0f} MB", flush=True)

        drive = LiveDrive(performer, transfer, [output], tell=tell)
        cpu_s, wall_s = time.process_time(), time.monotonic()
        drive.run()
        cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - wall_s
    settled = [mb for at_s, mb in memory_mb if at_s > min(60.0, 30.0 * minutes)] or [0.0]
    most_mb = max((mb for _, mb in memory_mb), default=0.0)
    print(f"{drive.shown} pictures; over the last two minutes {output.latencies}")
    print(f"left out: {dict(performer.counts)}, tracked but not drawn {drive.not_drawn}")
    print(f"memory {settled[0]:.0f} -> {settled[-1]:.0f} MB, most {most_mb:.0f} MB")
    print(f"{cpu_s / wall_s:.2f} cores busy")


def _without_camera(subject: Subject) -> None:
    """What a frame takes after it has been tracked."""
    if subject.dataset is None:
        return
    head = PerformerHead(subject.dataset.layout, subject.dataset.arrays)
    transfer = LiveTransfer(subject.avatar, subject.seen, head, subject.camera)
    output = PictureOutput(subject.avatar, subject.camera, (1.0, 1.0, 1.0), _Nowhere())
    times = {"transfer": [], "draw": []}
    for k, theta in enumerate(subject.dataset.theta[:200]):
        began_s = time.perf_counter()
        driven = transfer(PerformanceFrame(k, 0.0, k / _RATE, theta=theta))
        times["transfer"].append(time.perf_counter() - began_s)
        began_s = time.perf_counter()
        output.show(DrivenFrame(k, driven, 0.0, k / _RATE))
        times["draw"].append(time.perf_counter() - began_s)
    told = ", ".join(f"{name} {1e3 * np.median(taken):.1f} ms" for name, taken in times.items())
    print(f"a frame: {told} ({subject.avatar.num_gaussians} Gaussians)", flush=True)


def _to_and_fro(videos: list[Path], count: int) -> Iterator[np.ndarray]:
    """Frames of the videos forwards and backwards, without a jump, so many."""
    images = [frame.image_rgb for video in videos for frame in FrameSource.open(video)]
    for k in range(count):
        at = k % max(1, 2 * len(images) - 2)
        yield images[min(at, 2 * len(images) - 2 - at)]


if __name__ == "__main__":
    with told_without_traceback("drive.py"):
        tyro.cli(main)
