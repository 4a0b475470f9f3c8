"""How soon a still picture is sharp in a real browser, after each of many changes: a table.

    pytest -m nightly -s tests/plugin/test_viewer_sharpness.py

The times hold for a machine that does nothing else. While training runs, a sharp picture within the
first tenth of a second may have been begun before the change.
"""

from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset
from tests.browser import IN_BROWSER
from tests.plugin.run import finished_run
from tests.plugin.viewer_page import ViewerPage, started, viewer_page

_CHANGES = 15
_PATIENCE_S = 20.0
_SOON_S = 1.0
_MOST_LATE, _AT_LAST_S = 2, 4.0
"""None is late on a quiet machine; where neighbours work too, these still tell coarse from slow."""
_SHARP_PX = 1000
_PLAY_MS = 6000
_LEAST_PLAYED_PX = 256

pytestmark = [*IN_BROWSER, pytest.mark.nightly]


@pytest.fixture(scope="module")
def subject(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("subject") / "data"
    make_demo_dataset(folder, DemoConfig(image_size=128, num_frames=60, num_test_frames=10))
    return folder


@pytest.mark.parametrize("training", [False, True], ids=["finished", "training"])
def test_still_pictures_are_sharp_within_a_second(subject: Path, tmp_path: Path, training: bool):
    if training:
        command = ["ns-train", "rgbavatar-tiny", "--data", str(subject)]
        command += ["--output-dir", str(tmp_path), "--max-num-iterations", "1000000"]
    else:
        config = finished_run(subject, tmp_path, max_num_iterations=100)
        command = ["ns-viewer", "--load-config", str(config)]
    with started(command, tmp_path / "log") as address, viewer_page(address, 960, 749) as viewer:
        assert viewer.until_sharp(_SHARP_PX, 120.0) is not None
        table = Table("change", "first picture s", "its px", "sharp s", "canvas")
        times: list[float] = []
        for number in range(_CHANGES):
            name = _change(viewer, number)
            sharp = viewer.until_sharp(_SHARP_PX, _PATIENCE_S)
            first, share = viewer.pictures()[0], viewer.canvas_share
            times.append(_PATIENCE_S if sharp is None else sharp.after_s)
            size = f"{first.width} x {first.height}"
            first_s, sharp_s = f"{first.after_s:.2f}", f"{times[-1]:.2f}"
            table.add_row(name, first_s, size, sharp_s, f"{share:.2f}")
            assert share > 0.99
            viewer.page.wait_for_timeout(500)
        heights = _played_heights(viewer)
    Console().print(table)
    played = f"{len(heights) / _PLAY_MS * 1e3:.1f} pictures/s of {min(heights)} px and more"
    late = sum(seconds > _SOON_S for seconds in times)
    print(f"{late} of {_CHANGES} late; played {played}")
    assert min(heights) >= _LEAST_PLAYED_PX
    assert late <= _MOST_LATE
    assert max(times) < _AT_LAST_S


def _change(viewer: ViewerPage, number: int) -> str:
    """Make a change; what it was."""
    if number % 3 == 0:
        viewer.tab("Drive")
        viewer.set_number("Frame", str(3 * number + 2))
        return "frame"
    if number % 3 == 1:
        viewer.tab("Face")
        viewer.set_number("Jaw opens (°)", str(number))
        return "slider"
    viewer.drag(40.0 * (-1) ** number, 10.0)
    return "camera"


def _played_heights(viewer: ViewerPage) -> list[int]:
    """Of the pictures that playing showed."""
    viewer.tab("Drive")
    viewer.note_change()
    viewer.page.get_by_role("checkbox", name="Play").check()
    viewer.page.wait_for_timeout(_PLAY_MS)
    return [shown.height for shown in viewer.pictures()]
