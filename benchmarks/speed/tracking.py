"""What each stage of tracking costs a frame: CPU time and time by the clock.

    python benchmarks/speed/tracking.py me.mp4
    python benchmarks/speed/tracking.py --seed 3 --body lean --size 512 --frames 120

Without a video a procedural film is made and tracked. CPU time is the whole process's, so that on
a busy machine it tells what the clock does not; to compare two versions, run them by turns. The
person is fitted within the fit, once a clip: short clips pay more for it a frame.
"""

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import av
import numpy as np

from rgbavatar_ns.synthetic import DemoConfig, film_demo
from rgbavatar_ns.tracking import TrackConfig, track_video

_FRAMES_PER_SECOND = 24
_ROOM_CELLS = 64
"""The procedural room is so many patches wide: something for a camera's motion to show in."""


@dataclass
class _Costs:
    """CPU seconds of each stage, from the calls that tell its progress."""

    cpu_s: dict[str, float] = field(default_factory=dict)
    _last_s: float = field(default_factory=time.process_time)

    def __call__(self, stage: str, _done: int, _total: int | None) -> None:
        """What passed since the last call is this stage's."""
        now = time.process_time()
        self.cpu_s[stage] = self.cpu_s.get(stage, 0.0) + now - self._last_s
        self._last_s = now


def procedural_film(path: Path, config: DemoConfig) -> None:
    """A procedural person before a still wall, as a video."""
    film = film_demo(config)
    cells = np.random.default_rng(config.seed).integers(60, 200, (_ROOM_CELLS, _ROOM_CELLS, 3))
    row = np.arange(config.image_size) * _ROOM_CELLS // config.image_size
    room = cells[row][:, row].astype(np.float32)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=_FRAMES_PER_SECOND)
        stream.width = stream.height = config.image_size
        stream.pix_fmt, stream.bit_rate = "yuv420p", 8_000_000
        for frame in film.frames():
            alpha = frame.image_rgba[..., 3:].astype(np.float32) / 255
            image = frame.image_rgba[..., :3] * alpha + room * (1 - alpha)
            picture = av.VideoFrame.from_ndarray(image.astype(np.uint8), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def main() -> None:
    """Track a video and print what each stage took."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("video", type=Path, nargs="?", help="by default a procedural film")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--body", choices=("still", "lean", "none"), default="lean")
    parser.add_argument("--size", type=int, default=512, help="pixels of the procedural film")
    parser.add_argument("--frames", type=int, default=120)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        video = given.video
        if video is None:
            video = Path(folder) / "film.mp4"
            film = DemoConfig(
                image_size=given.size,
                num_frames=given.frames,
                num_test_frames=4,
                seed=given.seed,
                frames_per_second=float(_FRAMES_PER_SECOND),
                theta_noise=0.0,
                supersampling=1,
                glasses=False,
                body=given.body,
            )
            procedural_film(video, film)
        costs, began = _Costs(), time.perf_counter()
        dataset = Path(folder) / "dataset"
        track_video(video, dataset, TrackConfig(max_frames=given.frames), costs)
        wall_s = time.perf_counter() - began
        report = json.loads((dataset / "tracking.json").read_text())
    count = report["frames_read"]
    print("stage           CPU   clock   (ms a frame of the clip)")
    for stage, told in report["stages"].items():
        cpu_ms, clock_ms = (1e3 * s / count for s in (costs.cpu_s[stage], told["seconds"]))
        print(f"{stage:12} {cpu_ms:6.1f}  {clock_ms:6.1f}")
    total_ms = 1e3 * sum(costs.cpu_s.values()) / count
    print(
        f"{'all':12} {total_ms:6.1f}  {1e3 * wall_s / count:6.1f}   {count / wall_s:.1f} frames/s"
    )


if __name__ == "__main__":
    main()
