"""How an online run is doing: one line in a terminal, one now and then in a log."""

import time
from dataclasses import dataclass

from nerfstudio.utils.rich_utils import CONSOLE
from rich.status import Status
from rich.text import Text

from rgbavatar_ns.plugin.console import say

_SECONDS_PER_LINE = 10.0
_GOOD = ("arrived", "taken in")


@dataclass(frozen=True)
class StreamReport:
    """Where training and stream stand."""

    step: int
    frames: int
    fill: tuple[int, int]
    images: int
    latency_s: float | None
    psnr: float | None
    loss: float
    counts: dict[str, int]

    @property
    def troubles(self) -> dict[str, int]:
        """What went wrong with frames, and how often."""
        return {name: n for name, n in self.counts.items() if n and name not in _GOOD}

    def scalars(self) -> dict[str, float | int]:
        """Curves for TensorBoard, by name."""
        curves: dict[str, float | int] = {
            "Frames": self.frames,
            "Local Pool": self.fill[0],
            "Global Pool": self.fill[1],
            **{name.capitalize(): count for name, count in self.troubles.items()},
        }
        if self.latency_s is not None:
            curves["Latency Median (s)"] = self.latency_s
        if self.psnr is not None:
            curves["PSNR Last Second"] = self.psnr
        return curves

    def lines(self, images_per_second: float) -> list[str]:
        """What there is to say, one thing a line."""
        lines = [
            f"frame {self.frames}",
            f"pools {self.fill[0]} + {self.fill[1]}",
            f"{images_per_second:.1f} images/s",
        ]
        if self.latency_s is not None:
            lines.append(f"latency {self.latency_s:.2f} s")
        if self.psnr is not None:
            lines.append(f"PSNR of the last second {self.psnr:.1f} dB")
        lines.append(f"loss {self.loss:.4f}")
        return lines + [f"{name} {count}" for name, count in self.troubles.items()]


class OnlineProgress:
    """Shows reports; the rate is that between them."""

    def __init__(self) -> None:
        self._status: Status | None = None
        self._last_line_s = -_SECONDS_PER_LINE
        self._measured_s, self._measured_images = time.monotonic(), None
        self._rate = 0.0

    def __enter__(self) -> "OnlineProgress":
        if CONSOLE.is_terminal:
            self._status = CONSOLE.status("waiting for the first frame")
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is not None:
            self._status.stop()

    def images_per_second(self, images: int) -> float:
        """The rate over the last second or more, given the images drawn in all."""
        now = time.monotonic()
        if self._measured_images is None:
            self._measured_s, self._measured_images = now, images
        elif now - self._measured_s >= 1.0:
            self._rate = (images - self._measured_images) / (now - self._measured_s)
            self._measured_s, self._measured_images = now, images
        return self._rate

    def show(self, report: StreamReport, images_per_second: float) -> None:
        """Say where things stand, at most every ten seconds where there is no terminal."""
        text = f"step {report.step}: " + ", ".join(report.lines(images_per_second))
        if self._status is not None:
            self._status.update(Text(text))
            return
        now = time.monotonic()
        if now - self._last_line_s >= _SECONDS_PER_LINE:
            say(text)
            self._last_line_s = now
