"""nerfstudio's render thread may lose a request; it ends in a sharp picture all the same."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine

from rgbavatar_ns.plugin.viewer.redraw import Redraw
from tests.plugin.fake_viewer import FULL_SIZE, FakeViewer


class Trigger(threading.Event):
    """The render thread's event, which does not wait: time is told to pass.

    `clear` lies between the thread's look at its next action and its taking it away.
    """

    def __init__(self, idle: Callable[[], None]) -> None:
        super().__init__()
        self.idle, self.on_clear = idle, lambda: None

    def wait(self, timeout: float | None = None) -> bool:
        if not self.is_set():
            self.idle()
        return self.is_set()

    def clear(self) -> None:
        super().clear()
        self.on_clear()


class Browser:
    """One browser's render thread, run in the test's own; `shown` are the pictures sent to it."""

    def __init__(self) -> None:
        self.viewer, self.shown, self.value = FakeViewer(), [], "first"
        self.redraw = Redraw(self.viewer)
        self.now_s, self.insisting = 0.0, True
        self.viewer.get_model = lambda: SimpleNamespace(
            device=torch.device("cpu"),
            training=False,
            eval=lambda: None,
            get_outputs_for_camera=self.draw,
        )
        self.machine = RenderStateMachine(self.viewer, 10.0, SimpleNamespace())
        self.machine.render_trigger = Trigger(self.idle)
        self.machine._send_output_to_viewer = lambda outputs, **_: self.shown.append(outputs)
        self.viewer.render_statemachines[0] = self.machine

    def draw(self, camera: Cameras, obb_box: Any = None) -> Any:
        answered, value = self.redraw.began(self.now_s), self.value
        size = int(camera.width), int(camera.height)
        self.redraw.drew(self.machine, answered, *size)
        return value, max(size) == FULL_SIZE

    def idle(self) -> None:
        """A fifth of a second passes."""
        self.now_s += 0.2
        self.rounds -= 1
        self.machine.running = self.rounds > 0
        if self.insisting:
            self.redraw.insist(self.now_s)

    def rest(self, seconds: float = 5.0) -> Any:
        """Let time pass; the picture that then stands."""
        self.rounds, self.machine.running = round(seconds / 0.2), True
        self.machine.run()
        return self.shown[-1]

    def change(self, value: str) -> None:
        self.value = value
        self.redraw.ask(self.now_s)


@pytest.fixture
def browser(monkeypatch: pytest.MonkeyPatch) -> Browser:
    # The render thread draws coarsely at 30 pixels' height, and never measures itself here.
    monkeypatch.setattr("nerfstudio.viewer.render_state_machine.writer.is_initialized", bool)
    browser = Browser()
    assert browser.rest() == ("first", True)
    return browser


def test_a_change_is_drawn_coarsely_and_then_sharply_and_no_more(browser: Browser):
    browser.shown.clear()
    browser.change("second")
    browser.rest()
    assert browser.shown == [("second", False), ("second", True)]


def lose_the_request(browser: Browser) -> None:
    """A change comes while the thread at rest takes up its own "static"."""

    def come() -> None:
        browser.machine.render_trigger.on_clear = lambda: None
        browser.change("second")

    browser.machine.render_trigger.on_clear = come


def interrupt_late(browser: Browser) -> None:
    """A change's interruption comes late, when its own sharp picture is about to be drawn."""
    trigger = browser.machine.render_trigger

    def come() -> None:
        if browser.machine.state == "low_static":
            trigger.on_clear = lambda: None
            browser.machine.interrupt_render_flag = True

    browser.change("second")
    trigger.on_clear = come


@pytest.mark.parametrize(
    ("race", "left"),
    [(lose_the_request, ("first", True)), (interrupt_late, ("second", False))],
)
def test_a_lost_request_ends_in_a_sharp_picture(browser: Browser, race: Any, left: Any):
    race(browser)
    browser.insisting = False
    assert browser.rest() == left  # what nerfstudio leaves, for ever
    browser.insisting = True
    assert browser.rest() == ("second", True)
    count = len(browser.shown)
    browser.rest()
    assert len(browser.shown) == count


def test_a_camera_that_comes_to_rest_coarse_is_drawn_sharply(browser: Browser):
    state = browser.viewer.get_camera_state(None)
    browser.machine.action(RenderAction("move", state))
    browser.rest(0.4)
    browser.machine.state = "high"  # the sharp picture was interrupted, and nothing follows
    assert browser.rest() == ("first", True)


def test_a_thread_that_takes_the_action_away_meanwhile_ends_nothing(browser: Browser):
    class Taken(RenderStateMachine):
        def action(self, action: RenderAction) -> None:
            raise AttributeError("'NoneType' object has no attribute 'action'")

    browser.machine.__class__ = Taken
    browser.change("second")
    browser.machine.__class__ = RenderStateMachine
    assert browser.rest() == ("second", True)
