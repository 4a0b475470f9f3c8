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
from pathlib import Path

from procedural_film import film_config, write_film
from stage_times import StageTimes

from rgbavatar_ns.errors import told_without_traceback
from rgbavatar_ns.tracking import TrackConfig, track_video
from rgbavatar_ns.tracking.face.detector import load_mediapipe


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
            write_film(video, film_config(given.frames, given.size, given.seed, given.body))
        load_mediapipe()  # seconds of no stage
        costs = StageTimes()
        dataset = Path(folder) / "dataset"
        track_video(video, dataset, TrackConfig(max_frames=given.frames), costs)
        costs("after", 0, None)
        count = json.loads((dataset / "tracking.json").read_text())["frames_read"]
    print("stage           CPU   clock   (ms a frame of the clip)")
    for stage, cpu_s in costs.cpu_s.items():
        cpu_ms, clock_ms = (1e3 * s / count for s in (cpu_s, costs.clock_s[stage]))
        print(f"{stage:12} {cpu_ms:6.1f}  {clock_ms:6.1f}")
    cpu_s, clock_s = (sum(seconds.values()) for seconds in (costs.cpu_s, costs.clock_s))
    cpu_ms, clock_ms = 1e3 * cpu_s / count, 1e3 * clock_s / count
    print(f"{'all':12} {cpu_ms:6.1f}  {clock_ms:6.1f}   {count / clock_s:.1f} frames/s")


if __name__ == "__main__":
    with told_without_traceback("tracking.py"):
        main()
