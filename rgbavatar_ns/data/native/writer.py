"""Write a dataset frame by frame; a reader sees all of it or nothing."""

import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.data.native.dataset import TrackedDataset, load_native
from rgbavatar_ns.data.native.format import (
    FORMAT,
    HEAD_FILE,
    IMAGE_FOLDER,
    INDEX_FILE,
    THETA_FILE,
    camera_to_json,
    image_path,
)
from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.drawing.compositing import unfilmed_pixels
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_write, disk_errors, read_json, write_json
from rgbavatar_ns.head import HeadArrays, ThetaLayout
from rgbavatar_ns.kernels.types import PinholeCameras

UNFINISHED = ".unfinished"
"""Marks a folder whose files a writer has put there, until the index says so."""
_OWN_IMAGE = re.compile(r"\d{5,}\.png")


def make_room(root: Path, overwrite: bool) -> None:
    """Make the folder for a dataset; raises UserError where it cannot be made or may not be taken.

    It may be new, empty but for hidden files, or hold what an interrupted writer has left; with
    `overwrite` a dataset too, but never anything else: that would be lost.
    """
    if root.exists() and not root.is_dir():
        raise UserError(f"{root} is a file.", "Name a folder to write to.")
    with disk_errors(root, "Name a folder that you may write to."):
        root.mkdir(parents=True, exist_ok=True)
    if all(name.startswith(".") for name in os.listdir(root)):
        return
    index = read_json(root / INDEX_FILE)
    if index is None and (root / UNFINISHED).exists():
        return
    if not isinstance(index, dict) or index.get("format") != FORMAT:
        raise UserError(
            f"The folder {root} is not empty, and holds no dataset that may be replaced.",
            "Name a new folder.",
        )
    if not overwrite:
        raise UserError(
            f"The folder {root} is not empty.",
            "Name a new folder, or allow to overwrite the dataset in it (--overwrite).",
        )


def give_up(root: Path) -> None:
    """Take a dataset for what an interrupted writer has left, so that the next one replaces it."""
    with disk_errors(root, "Name a folder that you may write to."):
        (root / UNFINISHED).touch()
        (root / INDEX_FILE).unlink(missing_ok=True)


class DatasetWriter:
    """Writes the project's own format; `dataset.json` comes last and whole.

    What an interrupted writer left in a folder is replaced by the next.

    Args:
        arrays: the head model, or an embedded one's name (`EMBEDDED_HEAD`, `EMBEDDED_BUST`).
        overwrite: replace a dataset that is there; else a folder with anything in it is refused,
            as one of other things always is.
        keep_images: go on with an unfinished dataset: images that are there stay, for
            `add_encoded`. Implies overwrite.
        source: where the frames came from, for people to read.
        frames_per_second: the film's rate, if it is known.
    """

    def __init__(
        self,
        dst: str | Path,
        arrays: str | HeadArrays,
        identity: Float[Tensor, "I"],
        layout: ThetaLayout,
        width: int,
        height: int,
        overwrite: bool = False,
        keep_images: bool = False,
        source: Mapping[str, Any] | None = None,
        frames_per_second: float | None = None,
    ) -> None:
        self._root = Path(dst)
        self._arrays = arrays
        self._identity = identity.detach().to("cpu", torch.float32)
        self._layout = layout
        self._width, self._height = width, height
        self._theta: list[np.ndarray] = []
        self._frames: list[dict[str, Any]] = []
        self._numbers: set[int] = set()
        self._source = dict(source or {})
        self._rate = frames_per_second
        self._unfilmed = False
        self._clear(overwrite, keep_images)

    def _clear(self, overwrite: bool, keep_images: bool) -> None:
        """Make room; the old index goes first, so that no mixture can be taken for a dataset."""
        root, mark = self._root, self._root / UNFINISHED
        if not keep_images:
            make_room(root, overwrite)
        with disk_errors(root, "Name a folder that you may write to."):
            (root / IMAGE_FOLDER).mkdir(parents=True, exist_ok=True)
            mark.touch()
            for name in (INDEX_FILE, THETA_FILE, HEAD_FILE):
                (root / name).unlink(missing_ok=True)
            for image in () if keep_images else (root / IMAGE_FOLDER).iterdir():
                if _OWN_IMAGE.fullmatch(image.name):
                    image.unlink()

    def add(self, frame: TrackedFrame) -> None:
        """Write a frame's image now, the rest at the end; UserError where it does not fit."""
        height, width = frame.image_rgba.shape[:2]
        self._require_size(frame.index, width, height)
        self.add_encoded(
            frame.index,
            frame.theta,
            frame.camera,
            encode_png_rgba(frame.image_rgba),
            frame.camera_name,
            frame.timestep,
            bool(unfilmed_pixels(frame.image_rgba).any()),
        )

    def add_encoded(
        self,
        index: int,
        theta: Float[Tensor, "H"],
        camera: PinholeCameras,
        png: bytes | None,
        camera_name: str | None = None,
        timestep: int | None = None,
        has_unfilmed: bool = False,
    ) -> None:
        """As `add`, with a PNG file's bytes, its size trusted; None: it is in its place already.

        has_unfilmed: whether `UNFILMED_RGBA` is a mark in it; else it may be background.
        """
        name = f"frame {index}"
        if index in self._numbers:
            raise UserError(f"There are two frames {index}.", "Number frames once each.")
        values = theta.detach().to("cpu", torch.float32).numpy()
        if values.shape != (self._layout.size,):
            raise UserError(
                f"theta of {name} has {len(values)} values; the layout has {self._layout.size}.",
                "Make theta with the layout of the dataset's head (`ThetaLayout.join`).",
            )
        if not np.isfinite(values).all():
            raise UserError(f"theta of {name} holds NaN or infinity.", "Leave this frame out.")
        self._require_size(index, camera.width, camera.height)
        if png is not None:
            self.write_image(index, png)
        self._numbers.add(index)
        self._unfilmed |= has_unfilmed
        self._theta.append(values.copy())
        relative = self.image_path(index).relative_to(self._root).as_posix()
        entry = {"index": index, "image": relative, "camera": camera_to_json(camera, 0)}
        if camera_name is not None:
            entry["camera_name"] = camera_name
        if timestep is not None:
            entry["timestep"] = timestep
        self._frames.append(entry)

    def image_path(self, index: int) -> Path:
        """Where a frame's image lies."""
        return image_path(self._root, index)

    def write_image(self, index: int, png: bytes) -> None:
        """Put a PNG into its place ahead of `add_encoded`; several threads may do so."""
        # Not synced: there are thousands, and what a power cut cuts short is told when read.
        with atomic_write(self.image_path(index), sync=False) as partial:
            partial.write_bytes(png)

    def _require_size(self, index: int, width: int, height: int) -> None:
        if (width, height) != (self._width, self._height):
            raise UserError(
                f"Image or camera of frame {index} is not {self._width} x {self._height} pixels.",
                "Bring all images to one size, and scale the camera with them.",
            )

    def finish(self, test: int | Collection[int]) -> TrackedDataset:
        """Write theta, the head if it is not the embedded one, and the index; load the result.

        test: how many of the last frames are held out, or their numbers; one frame must remain.
        """
        held_out = test if isinstance(test, int) else len(set(test) & self._numbers)
        if not 0 <= held_out < len(self._frames):
            raise UserError(
                f"{held_out} of {len(self._frames)} frames cannot be held out.",
                "Hold out fewer frames, or write more.",
            )
        head = self._arrays
        if not isinstance(head, str):
            embedded = HeadArrays.embedded_as(head.name)
            if embedded is None or head.digest() != embedded.digest():
                head.save(self._root / HEAD_FILE)
            head = head.name
        index: dict[str, Any] = {
            "format": FORMAT,
            "version": 1,
            "head": head,
            "identity": self._identity.tolist(),
            "layout": self._layout.to_json(),
            "width": self._width,
            "height": self._height,
        }
        index |= self._split(test) | self._shared_cameras()
        if self._source:
            index["source"] = self._source
        if self._rate is not None:
            index["frames_per_second"] = self._rate
        of_version_2 = {"test", "cameras", "source"} & index.keys()
        if of_version_2 or any(len(frame) > 3 for frame in self._frames):
            index["version"] = 2
        if self._unfilmed:
            index |= {"unfilmed": True, "version": 3}
        index["frames"] = self._frames
        with atomic_write(self._root / THETA_FILE) as partial:
            np.save(partial, np.stack(self._theta))
        write_json(self._root / INDEX_FILE, index)
        (self._root / UNFINISHED).unlink(missing_ok=True)
        return load_native(self._root)

    def _split(self, test: int | Collection[int]) -> dict[str, Any]:
        """The held-out frames as a count where they are the last ones, else by number."""
        if isinstance(test, int):
            return {"test_frames": test}
        numbers = [frame["index"] for frame in self._frames]
        held_out = [number for number in numbers if number in set(test)]
        if held_out == numbers[len(numbers) - len(held_out) :]:
            return {"test_frames": len(held_out)}
        return {"test": held_out}

    def _shared_cameras(self) -> dict[str, Any]:
        """Cameras of many frames, taken out of them: one for all, or one of each name."""
        cameras = [frame["camera"] for frame in self._frames]
        if all(camera == cameras[0] for camera in cameras):
            for frame in self._frames:
                del frame["camera"]
            return {"camera": cameras[0]}
        if any("camera_name" not in frame for frame in self._frames):
            return {}
        named: dict[str, Any] = {}
        for frame in self._frames:
            if named.setdefault(frame["camera_name"], frame["camera"]) == frame["camera"]:
                frame["camera"] = frame["camera_name"]
        return {"cameras": named}
