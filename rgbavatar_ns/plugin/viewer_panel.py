"""The avatar's controls in nerfstudio's viewer; the only file that deals with viser."""

import base64
import math
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from nerfstudio.viewer.viewer_elements import (
    ViewerCheckbox,
    ViewerControl,
    ViewerDropdown,
    ViewerRGB,
    ViewerSlider,
)
from torch import Tensor, nn

# nerfstudio shows its world ten times as large in viser.
_VISER_PER_METRE = 10.0
_VISIBLE_HEIGHT_M = 0.45
_PLAYED_FRAMES_PER_SECOND = 12.0
_PATIENCE_S = 5.0
_TOPMOST = -1.0

BY_FRAME = "frame slider"
BY_TIME = "time slider"

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Viewpoint:
    """Where the viewer's camera starts, in nerfstudio's world, metres."""

    eye: Point
    look_at: Point


class ViewerPanel(nn.Module):
    """Chooses the dataset frame whose theta drives the avatar where a camera brings none.

    A module without parameters, because nerfstudio looks for controls in modules only; it lists
    them in the alphabetical order of their attributes.
    """

    def __init__(self, num_frames: int, viewpoint: Viewpoint) -> None:
        super().__init__()
        last = max(1, num_frames - 1)
        self.num_frames = num_frames
        self.driven_by = ViewerDropdown(
            "Driven by",
            BY_FRAME,
            [BY_FRAME, BY_TIME],
            hint="What chooses the frame: the slider below, or the viewer's own time",
        )
        self._noticed = threading.Event()
        self.frame = ViewerSlider(
            "Frame",
            0,
            0,
            last,
            1,
            cb_hook=lambda _: self._noticed.set(),
            hint="Frame of the dataset whose expression and pose are shown",
        )
        self.play = ViewerCheckbox("Play", False, hint="Move the frame slider on by itself")
        self.shade = ViewerRGB("Backdrop", (255, 255, 255), hint="Colour behind the head")
        self.start = _Start(self, viewpoint)

    @property
    def is_shown(self) -> bool:
        """Whether a viewer has installed the controls."""
        return self.frame.gui_handle is not None

    def position(self, times: Tensor | None) -> int:
        """Position of the driving frame for a camera without theta.

        In the viewer the frame slider decides, or the time if that is chosen and for previews of
        a camera path; without a viewer (`ns-render`) the camera's time in [0, 1] does.
        """
        by_time = not self.is_shown or self.driven_by.value == BY_TIME or self.start.previewing
        if by_time and times is not None:
            place = round(float(times.reshape(-1)[0]) * (self.num_frames - 1))
        else:
            place = int(self.frame.value)
        return min(max(place, 0), self.num_frames - 1)

    def background_color(self) -> Point:
        """The colour behind the head in [0, 1]; black without a viewer."""
        if not self.is_shown:
            return 0.0, 0.0, 0.0
        red, green, blue = self.shade.value
        return red / 255, green / 255, blue / 255

    def advance(self) -> None:
        """Show the next frame if the viewer is playing; after the last comes the first.

        Returns once the viewer has noticed, which it does between two pictures, so that frames
        do not queue up where drawing is slow.
        """
        if not self.play.value:
            return
        self._noticed.clear()
        self.frame.value = (int(self.frame.value) + 1) % self.num_frames
        if self.is_shown:
            self._noticed.wait(_PATIENCE_S)


class PanelNote(ViewerControl):
    """A picture and lines of text in a folder of its own at the panel's top."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._handle: Any = None
        self._picture = ""

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        gui = viewer.viser_server.gui
        with gui.add_folder(self._title, order=_TOPMOST):
            self._handle = gui.add_markdown("", image_root=Path())

    def show(self, lines: list[str], picture_rgb: UInt8[Tensor, "H W 3"] | None) -> None:
        """Put these in place of what was there; without a picture the last one stays.

        Does nothing without a viewer.
        """
        if self._handle is None:
            return
        if picture_rgb is not None:
            bgr = np.ascontiguousarray(picture_rgb.numpy()[..., ::-1])
            _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 85])
            data = base64.b64encode(jpeg.tobytes()).decode()
            self._picture = f"![](data:image/jpeg;base64,{data})"
        self._handle.content = "  \n".join([self._picture, *lines])


class _Start(ViewerControl):
    """Set-up that needs the viewer itself: where its camera starts, and who plays frames."""

    def __init__(self, panel: ViewerPanel, viewpoint: Viewpoint) -> None:
        self._panel = panel
        self._viewpoint = viewpoint
        self._viewer: Any = None

    @property
    def previewing(self) -> bool:
        """Whether the viewer is playing a camera path."""
        return self._viewer is not None and self._viewer.render_tab_state.preview_render

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        self._viewer = viewer
        viewer.viser_server.scene.set_up_direction("+z")
        viewer.viser_server.on_client_connect(self._place_camera)
        threading.Thread(target=self._play, name="viewer playback", daemon=True).start()

    def _place_camera(self, client: Any) -> None:
        eye, look_at = self._viewpoint.eye, self._viewpoint.look_at
        distance = math.dist(eye, look_at)
        with client.atomic():
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position = tuple(_VISER_PER_METRE * x for x in eye)
            client.camera.look_at = tuple(_VISER_PER_METRE * x for x in look_at)
            client.camera.fov = 2 * math.atan2(_VISIBLE_HEIGHT_M / 2, distance)

    def _play(self) -> None:
        while True:
            time.sleep(1 / _PLAYED_FRAMES_PER_SECOND)
            self._panel.advance()
