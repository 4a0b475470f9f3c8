"""What the viewer's panel needs of nerfstudio's viewer and viser, without browsers and threads."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.viewer.utils import CameraState

FULL_SIZE = 64


class FakeHandle:
    """A control; `user_sets` and `user_clicks` do what a browser does, and all that follows."""

    kind, limits = "", ()

    def __init__(self, label: str, value: Any, options: dict[str, Any]) -> None:
        self.label, self.value, self.options = label, value, options
        self.content, self.visible = value, options.get("visible", True)
        self._callbacks: list[Callable[[Any], None]] = []

    def on_update(self, callback: Callable[[Any], None]) -> None:
        self._callbacks.append(callback)

    on_click = on_update

    def user_sets(self, value: Any) -> None:
        self.value = value
        self.user_clicks()

    def user_clicks(self, client: Any = "browser") -> None:
        for callback in self._callbacks:
            callback(SimpleNamespace(client=client, target=self))

    def __setattr__(self, name: str, value: Any) -> None:
        """As in viser, a program that sets a value is told of it, but of no client."""
        told = name == "value" and "_callbacks" in vars(self)
        object.__setattr__(self, name, value)
        if told:
            self.user_clicks(client=None)

    def remove(self) -> None:
        self.label = ""

    @property
    def _impl(self) -> SimpleNamespace:
        """Where viser takes what it has no setter for."""
        messages = SimpleNamespace(queue_message=lambda message: self._becomes(**message.updates))
        return SimpleNamespace(id="", gui_api=SimpleNamespace(_websock_interface=messages))

    def _becomes(self, *, marks: tuple, hint: str, precision: int, **limits: float) -> None:
        self.limits = limits["min"], limits["max"], limits["step"], self.value
        ends = tuple(mark["value"] for mark in marks)
        self.options = self.options | {"marks": ends, "hint": hint, "precision": precision}

    def __enter__(self) -> "FakeHandle":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def add_tab(self, title: str) -> "FakeHandle":
        return FakeHandle(title, None, {})


class FakeGui:
    """viser's controls by their labels."""

    def __init__(self) -> None:
        self.handles: list[FakeHandle] = []

    def __getitem__(self, label: str) -> FakeHandle:
        return [handle for handle in self.handles if handle.label == label][-1]

    def texts(self) -> list[str]:
        """What stands in the panel's lines of text."""
        return [handle.content for handle in self.handles if handle.label == "markdown"]

    def __getattr__(self, name: str) -> Callable[..., FakeHandle]:
        kind = name.removeprefix("add_")

        def add(label: str = "", *values: Any, **options: Any) -> FakeHandle:
            if kind == "markdown":
                handle = FakeHandle(kind, label, options)
            elif kind == "dropdown":
                handle = FakeHandle(label, values[0][0], options)
            else:  # A slider's limits stand before its value.
                handle = FakeHandle(label, values[-1] if values else None, options)
                handle.limits = values
            handle.kind = kind
            self.handles.append(handle)
            return handle

        return add


class FakeViewer:
    """nerfstudio's viewer, whose state of all browsers' cameras is the same."""

    def __init__(self, training: str | None = None) -> None:
        self.gui = FakeGui()
        self.viser_server = SimpleNamespace(
            gui=self.gui,
            scene=SimpleNamespace(set_up_direction=lambda _: None),
            on_client_connect=lambda _: None,
        )
        self.render_tab_state = SimpleNamespace(preview_render=False)
        self.trainer = training and SimpleNamespace(training_state=training)
        buttons = [FakeHandle("button", None, {}) for _ in range(4)]
        self.pause_train, self.resume_train, *self.steering = buttons
        speed, share = (SimpleNamespace(gui_handle=handle) for handle in self.steering)
        self.control_panel = SimpleNamespace(
            time=0.0,
            max_res=FULL_SIZE,
            layer_depth=False,
            output_render="rgb",
            split=False,
            split_output_render="depth",
            _max_res=SimpleNamespace(value=FULL_SIZE),
            _train_speed=speed,
            _train_util=share,
        )
        self.last_move_time = 0.0
        self.include_time = self.ready = True
        self.render_statemachines: dict[int, Any] = {}
        self.train_lock, self.step = None, 0

    def get_camera_state(self, client: Any) -> CameraState:
        return CameraState(1.0, 1.0, torch.eye(4)[:3], CameraType.PERSPECTIVE)
