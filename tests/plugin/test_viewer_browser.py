"""ns-viewer in a real browser: the head is seen, and each control changes it and back, sharply."""

import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rgbavatar_ns.avatar import AvatarConfig
from tests.browser import IN_BROWSER
from tests.plugin.run import finished_run
from tests.plugin.viewer_page import Picture, ViewerPage, started, viewer_page

_WIDTH, _HEIGHT = 640, 620
_SECONDS_UNTIL_DRAWN = 120.0
_LOOK_MS = 250
_STAYS_S = 1.0
_SHARP_PX = 512
_SAME = 1e-4

_COUNT_FRAMES = """
window.frames_drawn = 0;
(function count() { window.frames_drawn++; requestAnimationFrame(count); })();
"""

_DECODE_ONE_LATE = """
const plain = Object.getOwnPropertyDescriptor(HTMLImageElement.prototype, "src");
let begun = 0;
window.late_ones = 0;
Object.defineProperty(HTMLImageElement.prototype, "src", {
  get: plain.get,
  set(url) {
    if (!url.startsWith("blob:") || begun++) return plain.set.call(this, url);
    setTimeout(() => {
      this.addEventListener("load", () => window.late_ones++);
      plain.set.call(this, url);
    }, 5000);
  },
});
"""

pytestmark = IN_BROWSER


@pytest.fixture
def viewer(tiny_data: Path, tmp_path: Path) -> Iterator[ViewerPage]:
    """ns-viewer's page of a run whose bases have learned something."""
    avatar = AvatarConfig(uv_resolution=48, num_bases=3, scale_from_texel_spacing=True)
    config = finished_run(tiny_data, tmp_path, avatar=avatar, max_num_iterations=80)
    command = ["ns-viewer", "--load-config", str(config)]
    with (
        started(command, tmp_path / "viewer.log") as address,
        viewer_page(address, _WIDTH, _HEIGHT) as page,
    ):
        yield page


def _colored(picture: Picture) -> float:
    """The share of pixels that are neither the white backdrop nor grey."""
    spread = picture.max(-1).astype(int) - picture.min(-1)
    return float((spread > 25).mean())


def _wait_for(viewer: ViewerPage, wanted: Callable[[Picture], bool]) -> Picture:
    """The first picture that stays, is sharp, and for which `wanted` holds."""
    deadline = time.monotonic() + _SECONDS_UNTIL_DRAWN
    picture, since = viewer.view(), time.monotonic()
    while (now := time.monotonic()) < deadline:
        viewer.page.wait_for_timeout(_LOOK_MS)
        before, picture = picture, viewer.view()
        if not np.array_equal(before, picture):
            since = time.monotonic()
        elif now - since >= _STAYS_S and wanted(picture) and _is_sharp(viewer):
            assert viewer.canvas_share > 0.99
            return picture
    Image.fromarray(picture).save(seen := Path(tempfile.gettempdir()) / "rgbavatar-viewer.png")
    raise AssertionError(f"the viewer did not show what was awaited, but {seen}")


def _is_sharp(viewer: ViewerPage) -> bool:
    last = viewer.pictures()[-1]
    return max(last.width, last.height) >= _SHARP_PX


def _wait_until_back(viewer: ViewerPage, first: Picture) -> None:
    _wait_for(viewer, lambda picture: _difference(picture, first) < _SAME)


def test_controls_change_the_picture_of_the_head_and_back(viewer: ViewerPage):
    first = _wait_for(viewer, lambda picture: _colored(picture) > 0.05)
    # The head stands in the middle, and the corners show the backdrop.
    height, width = first.shape[:2]
    middle = first[height // 3 : -height // 3, width // 3 : -width // 3]
    assert _colored(middle) > 0.5
    assert _colored(first[:40, :40]) == 0
    assert viewer.page.get_by_text("Pause Training").count() == 0

    viewer.set_number("Frame", "4")
    second = _wait_for(viewer, lambda picture: _difference(picture, first) > 0.02)
    assert _colored(second) > 0.05
    viewer.set_number("Frame", "0")
    _wait_until_back(viewer, first)

    # A picture that is decoded late does not take the place of a newer one.
    viewer.page.evaluate(_DECODE_ONE_LATE)
    viewer.set_number("Frame", "4")
    _wait_for(viewer, lambda picture: _difference(picture, first) > 0.02)
    viewer.set_number("Frame", "0")
    viewer.page.wait_for_function("window.late_ones === 1")
    viewer.page.wait_for_timeout(1000)
    _wait_until_back(viewer, first)

    viewer.tab("Face")
    viewer.set_number("Jaw opens (°)", "-15")
    _wait_for(viewer, lambda picture: _difference(picture, first) > 0.005)
    viewer.tab("Drive")
    viewer.choose("Driven by", "dataset frame")
    _wait_until_back(viewer, first)

    viewer.tab("Bases")
    viewer.set_number("Basis 1", "1")
    _wait_for(viewer, lambda picture: _difference(picture, first) > 0.002)
    viewer.page.get_by_role("checkbox", name="Hold weights").uncheck()
    _wait_until_back(viewer, first)

    viewer.tab("Look")
    viewer.choose("Picture", "beside the film")
    _wait_for(viewer, lambda picture: _difference(picture, first) > 0.05)
    viewer.choose("Picture", "avatar")
    _wait_until_back(viewer, first)

    # Where nothing happens the page hardly draws, once its first ten seconds are over.
    viewer.page.wait_for_function("performance.now() > 13000")
    viewer.page.evaluate(_COUNT_FRAMES)
    viewer.page.wait_for_timeout(2000)
    assert 2 <= viewer.page.evaluate("window.frames_drawn") <= 12

    viewer.tab("Drive")
    number = viewer.number_beside("Frame")
    viewer.page.get_by_role("checkbox", name="Play").check()
    deadline = time.monotonic() + _SECONDS_UNTIL_DRAWN
    while number.input_value() in ("0", "1"):
        assert time.monotonic() < deadline, "playing does not move the frame on"
        viewer.page.wait_for_timeout(50)
    assert viewer.canvas_share > 0.99


def _difference(picture: Picture, other: Picture) -> float:
    return float((np.abs(picture.astype(int) - other).max(-1) > 20).mean())
