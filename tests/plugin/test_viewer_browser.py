"""ns-viewer in a real browser: the head is seen, and each control changes it and back."""

import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from rgbavatar_ns.avatar import AvatarConfig
from tests.browser import IN_BROWSER, chromium, picture_of
from tests.plugin.run import environment, finished_run, program

_WIDTH, _HEIGHT = 900, 950
_PANEL_WIDTH = 330
_SECONDS_UNTIL_DRAWN = 120.0
_LOOK_MS = 250
_SAME_PICTURES = 3
_SHARP_PX = 512
_SIZE = re.compile(r"Resolution: \d+x\d+px")
_SAME = 1e-4

pytestmark = IN_BROWSER

Picture = npt.NDArray[np.uint8]


@pytest.fixture
def viewer_address(tiny_data: Path, tmp_path: Path) -> Iterator[str]:
    """Where ns-viewer shows a run whose bases have learned something."""
    avatar = AvatarConfig(uv_resolution=48, num_bases=3, scale_from_texel_spacing=True)
    config = finished_run(tiny_data, tmp_path, avatar=avatar, max_num_iterations=150)
    log = tmp_path / "viewer.log"
    command = [program("ns-viewer"), "--load-config", str(config)]
    command += ["--viewer.websocket-host", "127.0.0.1"]
    with log.open("w") as output:
        process = subprocess.Popen(
            command, stdout=output, stderr=subprocess.STDOUT, env=environment()
        )
        try:
            yield _address(process, log)
        finally:
            process.kill()
            process.wait()


def _address(process: "subprocess.Popen[bytes]", log: Path) -> str:
    for _ in range(3000):
        found = re.search(r"http://127\.0\.0\.1:\d+", log.read_text())
        if found:
            return found.group(0)
        assert process.poll() is None, log.read_text()
        time.sleep(0.1)
    raise AssertionError(log.read_text())


@pytest.fixture
def page(viewer_address: str) -> Iterator[Any]:
    """The viewer's page in a headless browser."""
    with chromium() as browser:
        page = browser.new_page(viewport={"width": _WIDTH, "height": _HEIGHT})
        page.goto(viewer_address)
        yield page


def _canvas(page: Any) -> Picture:
    """The 3D view, left of the control panel, below the title and above the axes."""
    return picture_of(page.screenshot())[80 : _HEIGHT - 80, : _WIDTH - _PANEL_WIDTH]


def _colored(picture: Picture) -> float:
    """The share of pixels that are neither the white backdrop nor grey."""
    spread = picture.max(-1).astype(int) - picture.min(-1)
    return float((spread > 25).mean())


def _wait_for(page: Any, wanted: Callable[[Picture], bool]) -> Picture:
    """The first sharp picture that stays and for which `wanted` holds.

    The viewer draws coarsely first and, once nothing has moved for a while, sharply. On a busy
    machine a coarse one stays for long, but nerfstudio names the size of the last that it sent.
    """
    deadline = time.monotonic() + _SECONDS_UNTIL_DRAWN
    picture, same, size = _canvas(page), 0, ""
    while time.monotonic() < deadline:
        page.wait_for_timeout(_LOOK_MS)
        before, picture = picture, _canvas(page)
        size = page.get_by_text(_SIZE).first.inner_text()
        sharp = max(map(int, re.findall(r"\d+", size.partition("Resolution")[2]))) >= _SHARP_PX
        same = same + 1 if sharp and np.array_equal(before, picture) else 0
        if same >= _SAME_PICTURES and wanted(picture):
            return picture
    Image.fromarray(picture).save(seen := Path(tempfile.gettempdir()) / "rgbavatar-viewer.png")
    raise AssertionError(f"the viewer did not show what was awaited, but {seen} ({size})")


def _wait_until_back(page: Any, first: Picture) -> None:
    _wait_for(page, lambda picture: _difference(picture, first) < _SAME)


def test_controls_change_the_picture_of_the_head_and_back(page: Any):
    first = _wait_for(page, lambda picture: _colored(picture) > 0.05)
    # The head stands in the middle, and the corners show the backdrop.
    height, width = first.shape[:2]
    middle = first[height // 3 : -height // 3, width // 3 : -width // 3]
    assert _colored(middle) > 0.5
    assert _colored(first[:40, :40]) == 0

    _set_number(page, "Frame", "4")
    second = _wait_for(page, lambda picture: _difference(picture, first) > 0.02)
    assert _colored(second) > 0.05
    _set_number(page, "Frame", "0")
    _wait_until_back(page, first)

    _tab(page, "Face")
    _set_number(page, "jaw x (deg)", "-15")
    _wait_for(page, lambda picture: _difference(picture, first) > 0.005)
    _tab(page, "Drive")
    _choose(page, "Driven by", "dataset frame")
    _wait_until_back(page, first)

    _tab(page, "Bases")
    _set_number(page, "psi 0", "1")
    _wait_for(page, lambda picture: _difference(picture, first) > 0.002)
    page.get_by_role("checkbox", name="Weights by hand").uncheck()
    _wait_until_back(page, first)

    _tab(page, "Look")
    _choose(page, "Picture", "beside the film")
    _wait_for(page, lambda picture: _difference(picture, first) > 0.05)
    _choose(page, "Picture", "avatar")
    _wait_until_back(page, first)

    _tab(page, "Drive")
    number = _number_beside(page, "Frame")
    page.get_by_role("checkbox", name="Play").check()
    deadline = time.monotonic() + _SECONDS_UNTIL_DRAWN
    while number.input_value() == "0":
        assert time.monotonic() < deadline, "playing does not move the frame on"
        page.wait_for_timeout(50)


def _tab(page: Any, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def _choose(page: Any, label: str, option: str) -> None:
    place = f"//*[normalize-space(text())='{label}']/following::input[1]"
    page.locator(f"xpath={place}").click()
    page.get_by_role("option", name=option, exact=True).click()


def _set_number(page: Any, label: str, value: str) -> None:
    number = _number_beside(page, label)
    number.fill(value)
    number.press("Enter")


def _number_beside(page: Any, label: str) -> Any:
    place = f"//*[normalize-space(text())='{label}']/following::input[@inputmode='numeric'][1]"
    return page.locator(f"xpath={place}")


def _difference(picture: Picture, other: Picture) -> float:
    return float((np.abs(picture.astype(int) - other).max(-1) > 20).mean())
