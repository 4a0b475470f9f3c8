"""The one place that asks nerfstudio's viewer for pictures, and sees that the last one is sharp.

In nerfstudio 1.1.5 other threads leave an action for a browser's render thread without a lock. A
move that comes while the thread takes up its own "static" is lost, and its interruption, when it
comes late, ends a full-resolution picture that nothing draws again: the viewer stays as it was, or
coarse, for as long as nobody touches it.
"""

import threading
from contextlib import suppress
from typing import Any
from weakref import WeakKeyDictionary

from nerfstudio.viewer.render_state_machine import RenderAction, RenderActions

_PATIENCE_S = 1.0
_COARSE = 0


class Redraw:
    """Asks the render threads of all browsers for the newest state, again where it was lost.

    `began` and `drew` are called where pictures are drawn: there nerfstudio may interrupt each
    line, so that they take no locks.
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._asked = 1
        self._sharp: WeakKeyDictionary[threading.Thread, int] = WeakKeyDictionary()
        self._busy_s = 0.0

    def ask(self, now_s: float) -> None:
        """Draw anew in all browsers: coarsely at once, then sharply."""
        self._asked += 1
        self._busy_s = now_s
        if self._viewer.ready:
            for machine in self._machines():
                self._act(machine, "move")

    def began(self, now_s: float) -> int:
        """A picture is begun: what it answers."""
        self._busy_s = now_s
        return self._asked

    def drew(self, thread: threading.Thread, answered: int, width: int, height: int) -> None:
        """A picture has been drawn in that render thread."""
        sharp = max(width, height) >= self._viewer.control_panel.max_res
        self._sharp[thread] = answered if sharp else _COARSE

    def insist(self, now_s: float) -> None:
        """Draw at full resolution where all is at rest and the last picture is not that.

        A "step" interrupts nothing, and leaves the other states alone, which go on by themselves.
        """
        if now_s < self._busy_s + _PATIENCE_S:
            return
        self._busy_s = now_s
        for machine in self._machines():
            if machine.state == "high" and self._sharp.get(machine, _COARSE) < self._asked:
                self._act(machine, "step")

    def _machines(self) -> list[Any]:
        """nerfstudio's `RenderStateMachine` of each browser, which is a thread."""
        return list(self._viewer.render_statemachines.values())

    def _act(self, machine: Any, action: RenderActions) -> None:
        # The thread may take the action away between two looks at it; then it draws in any case.
        with suppress(AttributeError):
            machine.action(RenderAction(action, self._viewer.get_camera_state(machine.client)))
