"""Whatever happens meanwhile, what is at rest is shown as it is, at full resolution."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import nerfstudio.viewer.viewer
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.render_state_machine import RenderStateMachine

from rgbavatar_ns.plugin.viewer.render_thread import (
    RenderThread,
    ask_for_pictures,
    draw_by_render_threads,
)
from tests.plugin.fake_viewer import FakeViewer

_FULL_PX = 1024


class Browser:
    """One browser's thread, run in the test's own; `shown` are the pictures sent to it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.viewer, self.shown, self.value, self.now_s = FakeViewer(), [], "first", 0.0
        self.viewer.control_panel.max_res = _FULL_PX
        self.seconds: Callable[[int], float] = lambda height: 0.01
        self.meanwhile: Callable[[], None] = lambda: None
        self.viewer.get_model = lambda: SimpleNamespace(
            device=torch.device("cpu"), get_outputs_for_camera=self.draw
        )
        self.thread = RenderThread(self.viewer, 10.0, SimpleNamespace(), lambda: self.now_s)
        monkeypatch.setattr(self.thread._changed, "wait", self.pass_time)
        self.thread._send_output_to_viewer = lambda outputs, static_render: self.shown.append(
            (self.drawn, outputs["rgb"].shape[0], static_render)
        )
        self.viewer.render_statemachines[0] = self.thread

    def draw(self, camera: Cameras) -> dict[str, torch.Tensor]:
        self.drawn, height = self.value, int(camera.height)
        self.now_s += self.seconds(height)
        meanwhile, self.meanwhile = self.meanwhile, lambda: None
        meanwhile()
        return {"rgb": torch.zeros(height, 1, 3)}

    def pass_time(self, seconds: float) -> None:
        self.now_s += max(seconds, 1e-3)

    def rest(self) -> Any:
        """Let time pass; the picture that then stands."""
        until_s = self.now_s + 2.0
        while self.now_s < until_s:
            self.thread.draw_next()
        return self.shown[-1]

    def change(self, value: str) -> None:
        self.value = value
        ask_for_pictures(self.viewer, hold_training=True)


@pytest.fixture
def browser(monkeypatch: pytest.MonkeyPatch) -> Browser:
    browser = Browser(monkeypatch)
    assert browser.rest() == ("first", _FULL_PX, True)
    return browser


def test_a_change_is_drawn_at_once_and_then_sharply_and_no_more(browser: Browser):
    browser.shown.clear()
    changed_s = browser.now_s
    browser.change("second")
    browser.thread.draw_next()
    assert (browser.shown[0][0], browser.shown[0][2]) == ("second", False)
    assert browser.now_s < changed_s + 0.02
    assert browser.rest() == ("second", _FULL_PX, True)
    assert len(browser.shown) == 2


@pytest.mark.parametrize("pictures_before", [0, 1])
def test_a_change_during_a_picture_is_shown_after_it(browser: Browser, pictures_before: int):
    browser.change("second")
    for _ in range(pictures_before):
        browser.thread.draw_next()
    browser.meanwhile = lambda: browser.change("third")
    assert browser.rest() == ("third", _FULL_PX, True)


def test_what_waited_for_a_step_of_training_is_drawn_sharply_at_once(browser: Browser):
    class Step:
        def __enter__(self) -> None:
            browser.now_s += 0.5

        def __exit__(self, *_: object) -> None:
            pass

    browser.shown.clear()
    browser.viewer.train_lock = Step()
    browser.change("second")
    browser.thread.draw_next()
    assert browser.shown == [("second", _FULL_PX, True)]


@pytest.mark.parametrize(
    ("seconds_per_full", "least", "most"), [(0.005, 1024, 1024), (0.16, 500, 524), (9.0, 256, 256)]
)
def test_moving_pictures_are_as_large_as_their_time_allows(
    browser: Browser, seconds_per_full: float, least: int, most: int
):
    browser.seconds = lambda height: seconds_per_full * (height / _FULL_PX) ** 2
    browser.shown.clear()
    for frame in range(30):
        browser.change(str(frame))
        browser.thread.draw_next()
    value, height, sharp = browser.shown[-1]
    assert value == "29"
    assert not sharp
    assert least <= height <= most
    assert browser.rest() == ("29", _FULL_PX, True)


def test_training_waits_for_the_user_but_not_for_a_film_that_plays(browser: Browser):
    browser.viewer.last_move_time = 0.0
    ask_for_pictures(browser.viewer, hold_training=False)
    assert browser.viewer.last_move_time == 0
    ask_for_pictures(browser.viewer, hold_training=True)
    assert browser.viewer.last_move_time > 0


def test_browsers_that_were_there_before_and_later_ones_are_drawn_for(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr("nerfstudio.viewer.viewer.RenderStateMachine", RenderStateMachine)
    viewer = FakeViewer()
    viewer.ready = False
    earlier = RenderStateMachine(viewer, 10.0, SimpleNamespace())
    earlier.start()
    viewer.render_statemachines[3] = earlier
    draw_by_render_threads(viewer)
    assert nerfstudio.viewer.viewer.RenderStateMachine is RenderThread
    thread = viewer.render_statemachines[3]
    assert isinstance(thread, RenderThread)
    assert thread.is_alive()
    thread.running = False
    for each in (earlier, thread):
        each.join(5.0)
        assert not each.is_alive()
