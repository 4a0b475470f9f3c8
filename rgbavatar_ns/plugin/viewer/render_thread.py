"""What draws for one browser: quickly while something moves, at full resolution once it rests."""

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any

import nerfstudio.viewer.viewer
import torch
from nerfstudio.utils import writer
from nerfstudio.utils.writer import EventName
from nerfstudio.viewer.render_state_machine import RenderAction, RenderStateMachine
from nerfstudio.viewer.utils import get_camera
from torch import Tensor

from rgbavatar_ns.threads import using_threads

_BUDGET_S = 1 / 25
"""A moving picture may take so long to draw and to send."""
_LEAST_HEIGHT_PX = 256
_MOST_CHANGE = 1.5
_REST_S = 0.08
"""What has not moved for so long rests; training waits for .1 s."""
_LOOK_S = 0.2


class RenderThread(RenderStateMachine):
    """Draws the newest request, and the last one at full resolution.

    It stands in for nerfstudio 1.1.5's own thread. There other threads leave an action without a
    lock, so that one may be lost, and interrupt pictures, one of which may be the last: the viewer
    stays as it was, or coarse. Its moving pictures are as large as their time allows, the wait for
    training's lock counted: 30 pixels where a step takes long. An avatar is drawn in milliseconds:
    nothing here is interrupted, and only drawing counts.
    """

    def __init__(
        self,
        viewer: Any,
        viser_scale_ratio: float,
        client: Any,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(viewer, viser_scale_ratio, client)
        self._clock = clock
        self._changed = threading.Condition()
        self._asked, self._answered, self._sharp = 1, 0, False
        self._moved_s = clock()
        self._height_px = float(viewer.control_panel.max_res)

    def action(self, action: RenderAction) -> None:
        """Ask for a picture: "step" of what rests, anything else of what moves."""
        with self._changed:
            self._asked += 1
            if action.action != "step":
                self._moved_s = self._clock()
            self._changed.notify()

    def run(self) -> None:
        """Draw what is asked for until `running` is False."""
        while self.running:
            self.draw_next()

    def draw_next(self) -> None:
        """Draw the next picture, or return after a while where there is none to draw yet."""
        with self._changed:
            answered = self._asked == self._answered
            moved_s_ago = self._clock() - self._moved_s
            if not self.viewer.ready or (answered and self._sharp):
                self._changed.wait(_LOOK_S)
                return
            if answered and moved_s_ago < _REST_S:
                self._changed.wait(_REST_S - moved_s_ago)
                return
        outputs = self._draw()
        began_s = self._clock()
        with using_threads(1):
            self._send_output_to_viewer(outputs, static_render=self._sharp)
        if not self._sharp:
            sent_s = self._clock()
            self._fit(self._drawn_in_s + sent_s - began_s)
            self._moved_s = max(self._moved_s, sent_s)

    def _draw(self) -> dict[str, Tensor]:
        viewer = self.viewer
        lock = contextlib.nullcontext() if viewer.train_lock is None else viewer.train_lock
        with lock, torch.no_grad():
            # Where a step was waited for, what moved before may rest by now.
            began_s = self._clock()
            self._answered = self._asked
            self._sharp = began_s - self._moved_s >= _REST_S
            camera_state = viewer.get_camera_state(self.client)
            if not viewer.render_tab_state.preview_render and viewer.include_time:
                camera_state.time = viewer.control_panel.time
            height, width = self._size(camera_state.aspect)
            model = viewer.get_model()
            camera = get_camera(camera_state, height, width).to(model.device)
            outputs = model.get_outputs_for_camera(camera)
        self._drawn_in_s = max(self._clock() - began_s, 1e-4)
        if writer.is_initialized():  # By it the viewer shares the device with training.
            rate = height * width / self._drawn_in_s
            writer.put_time(EventName.VIS_RAYS_PER_SEC, rate, viewer.step, avg_over_steps=True)
        if viewer.control_panel.layer_depth:
            outputs["gl_z_buf_depth"] = outputs["depth"]
        return outputs

    def _fit(self, seconds: float) -> None:
        """A moving picture took so long: the next one may be larger, or has to be smaller."""
        change = (_BUDGET_S / max(seconds, 1e-4)) ** 0.5
        change = min(max(change, 1 / _MOST_CHANGE), _MOST_CHANGE)
        limits = _LEAST_HEIGHT_PX, self.viewer.control_panel.max_res
        self._height_px = min(max(self._height_px * change, limits[0]), limits[1])

    def _size(self, aspect_ratio: float) -> tuple[int, int]:
        """Height and width of the next picture in pixels."""
        longest = self.viewer.control_panel.max_res
        full = min(longest, longest / aspect_ratio)
        height = full if self._sharp else min(full, self._height_px)
        return max(1, int(height)), max(1, int(height * aspect_ratio))


def draw_by_render_threads(viewer: Any) -> None:
    """Let these draw for all browsers of nerfstudio's viewer, which is not ready yet."""
    nerfstudio.viewer.viewer.RenderStateMachine = RenderThread  # type: ignore
    for number, plain in list(viewer.render_statemachines.items()):
        plain.running = False  # It waits for the viewer and has drawn nothing yet.
        thread = RenderThread(viewer, plain.viser_scale_ratio, plain.client)
        viewer.render_statemachines[number] = thread
        thread.start()


def ask_for_pictures(viewer: Any, *, hold_training: bool) -> None:
    """Draw anew in all browsers: something has moved. Training may wait, as for a camera."""
    if hold_training:
        viewer.last_move_time = time.time()
    for thread in list(viewer.render_statemachines.values()):
        thread.action(RenderAction("move", viewer.get_camera_state(thread.client)))
