"""A note in nerfstudio's viewer: a picture and lines of text."""

import base64
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor

_TOPMOST = -1.0


class StatusPanel(ViewerControl):
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
