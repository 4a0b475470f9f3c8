"""nerfstudio's viewer of one run in a real browser: what a user does there, and what is seen."""

import re
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.browser import chromium, picture_of
from tests.plugin.run import environment, program

_PANEL_WIDTH = 330
_SECONDS_UNTIL_STARTED = 300.0
_LOOK_MS = 50
# Pictures are noted as they go to the graphics card, with the size of the canvas that shows them.
_WATCH = """
window.shownPictures = [];
for (const name of ["texImage2D", "texSubImage2D"]) {
  const plain = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...all) {
    const image = all[all.length - 1];
    const canvas = this.canvas;
    if (image instanceof HTMLImageElement &&
        Math.abs(image.width / image.height - canvas.width / canvas.height) < 0.05)
      window.shownPictures.push([performance.now(), image.width, image.height]);
    return plain.apply(this, all);
  };
}
"""
_CANVAS = "document.querySelector('canvas[data-engine]')"

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Shown:
    """A picture that the browser has shown."""

    after_s: float
    """Since the change that it followed."""
    width: int
    height: int


@contextmanager
def started(command: list[str], log: Path) -> Iterator[str]:
    """Run one of nerfstudio's commands; the address of its viewer."""
    with log.open("w") as output:
        process = subprocess.Popen(
            [program(command[0]), *command[1:]],
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment(),
        )
        try:
            yield _address(process, log)
        finally:
            process.kill()
            process.wait()


def _address(process: "subprocess.Popen[bytes]", log: Path) -> str:
    deadline = time.monotonic() + _SECONDS_UNTIL_STARTED
    while time.monotonic() < deadline:
        found = re.search(r"http://[\w.]+:\d+", log.read_text())
        if found:
            return found.group(0)
        assert process.poll() is None, log.read_text()
        time.sleep(0.1)
    raise AssertionError(log.read_text())


class ViewerPage:
    """The viewer's page, its panel on the right of the 3D view."""

    def __init__(self, page: Any, address: str) -> None:
        self.page = page
        page.add_init_script(_WATCH)
        page.goto(address)
        self._changed_ms = 0.0

    @property
    def canvas_share(self) -> float:
        """The canvas's own pixels for each pixel of the screen, along one side."""
        return float(self.page.evaluate(f"{_CANVAS}.width / {_CANVAS}.clientWidth"))

    def view(self) -> Picture:
        """The 3D view, left of the control panel, below the title and above the axes."""
        picture = picture_of(self.page.screenshot())
        return picture[80:-80, : picture.shape[1] - _PANEL_WIDTH]

    def note_change(self) -> None:
        """From now on pictures follow this change."""
        self._changed_ms = float(self.page.evaluate("performance.now()"))

    def pictures(self) -> list[Shown]:
        """What was shown since the last change."""
        return [
            Shown((at_ms - self._changed_ms) / 1e3, width, height)
            for at_ms, width, height in self.page.evaluate("window.shownPictures")
            if at_ms > self._changed_ms
        ]

    def until_sharp(self, side_px: int, patience_s: float) -> Shown | None:
        """The first picture since the last change that has so many pixels along its longer side."""
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline:
            for shown in self.pictures():
                if max(shown.width, shown.height) >= side_px:
                    return shown
            self.page.wait_for_timeout(_LOOK_MS)
        return None

    def tab(self, name: str) -> None:
        """Open one of the panel's tabs."""
        self.page.get_by_role("tab", name=name, exact=True).click()

    def choose(self, label: str, option: str) -> None:
        """Choose in a list."""
        place = f"//*[normalize-space(text())='{label}']/following::input[1]"
        self.page.locator(f"xpath={place}").click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def set_number(self, label: str, value: str) -> None:
        """Type a slider's number."""
        number = self.number_beside(label)
        self.note_change()  # before: what is filled in is drawn at once
        number.fill(value)
        number.press("Enter")

    def number_beside(self, label: str) -> Any:
        """A slider's number."""
        place = f"//*[normalize-space(text())='{label}']/following::input[@inputmode='numeric'][1]"
        return self.page.locator(f"xpath={place}")

    def drag(self, across_px: float, down_px: float) -> None:
        """Turn the camera with the mouse."""
        mouse = self.page.mouse
        mouse.move(300, 400)
        mouse.down()
        mouse.move(300 + across_px, 400 + down_px, steps=4)
        mouse.up()
        self.note_change()


@contextmanager
def viewer_page(address: str, width: int, height: int) -> Iterator[ViewerPage]:
    """The viewer in a headless browser's window of that size."""
    with chromium() as browser:
        page = browser.new_page(viewport={"width": width, "height": height})
        yield ViewerPage(page, address)
