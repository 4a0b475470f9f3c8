"""Write a dataset frame by frame; a reader sees all of it or nothing."""

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.data.dataset import TrackedDataset, load_dataset
from rgbavatar_ns.data.frame import TrackedFrame
from rgbavatar_ns.data.native_format import (
    FORMAT,
    HEAD_FILE,
    IMAGE_FOLDER,
    INDEX_FILE,
    THETA_FILE,
    VERSION,
    camera_to_json,
)
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, ThetaLayout


class DatasetWriter:
    """Writes the project's own format; `dataset.json` comes last and whole.

    Args:
        dst: folder to write to; made where missing.
        arrays: the head model, or the embedded one's name ("makehuman").
        identity: the person's identity coefficients.
        layout: what theta holds.
        width, height: of every image, in pixels.
        overwrite: replace a dataset that is there; else a folder with anything in it is refused.
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
    ) -> None:
        self._root = Path(dst)
        self._arrays = arrays
        self._identity = identity.detach().to("cpu", torch.float32)
        self._layout = layout
        self._width, self._height = width, height
        self._theta: list[np.ndarray] = []
        self._frames: list[dict[str, Any]] = []
        self._numbers: set[int] = set()
        self._clear(overwrite)

    def _clear(self, overwrite: bool) -> None:
        """Make room; the old index goes first, so that no mixture can be taken for a dataset."""
        if self._root.exists() and not self._root.is_dir():
            raise UserError(f"{self._root} is a file.", "Name a folder to write to.")
        if not overwrite and self._root.exists() and any(self._root.iterdir()):
            raise UserError(
                f"The folder {self._root} is not empty.",
                "Name a new folder, or allow to overwrite the dataset in it.",
            )
        for name in (INDEX_FILE, THETA_FILE, HEAD_FILE):
            (self._root / name).unlink(missing_ok=True)
        for image in (self._root / IMAGE_FOLDER).glob("*.png"):
            image.unlink()
        try:
            (self._root / IMAGE_FOLDER).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"The folder {self._root} cannot be made: {error.strerror}.",
                "Name a folder that you may write to.",
            ) from None

    def add(self, frame: TrackedFrame) -> None:
        """Write a frame's image now; the rest follows at the end.

        Raises UserError where its number was used before, theta does not fit the layout or is
        not finite, or the image has another size.
        """
        name = f"frame {frame.index}"
        if frame.index in self._numbers:
            raise UserError(f"There are two frames {frame.index}.", "Number frames once each.")
        theta = frame.theta.detach().to("cpu", torch.float32).numpy()
        if theta.shape != (self._layout.size,):
            raise UserError(
                f"theta of {name} has {len(theta)} values; the layout has {self._layout.size}.",
                "Make theta with the layout of the dataset's head (`ThetaLayout.join`).",
            )
        if not np.isfinite(theta).all():
            raise UserError(f"theta of {name} holds NaN or infinity.", "Leave this frame out.")
        height, width = frame.image_rgba.shape[:2]
        sizes = {(width, height), (frame.camera.width, frame.camera.height)}
        if sizes != {(self._width, self._height)}:
            raise UserError(
                f"Image or camera of {name} is not {self._width} x {self._height} pixels.",
                "Bring all images to one size, and scale the camera with them.",
            )
        relative = f"{IMAGE_FOLDER}/{frame.index:05d}.png"
        encoded = encode_png_rgba(frame.image_rgba)
        _write_whole(self._root / relative, lambda file: file.write(encoded))
        self._numbers.add(frame.index)
        self._theta.append(theta.copy())
        camera = camera_to_json(frame.camera, 0)
        self._frames.append({"index": frame.index, "image": relative, "camera": camera})

    def finish(self, test_frames: int) -> TrackedDataset:
        """Write theta, the head if it is not the embedded one, and the index; load the result.

        test_frames: how many of the last frames are held out; at least one must remain.
        """
        if not 0 <= test_frames < len(self._frames):
            raise UserError(
                f"{test_frames} of {len(self._frames)} frames cannot be held out.",
                "Hold out fewer frames, or write more.",
            )
        index: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "head": self._write_head(),
            "identity": self._identity.tolist(),
            "layout": self._layout.to_json(),
            "width": self._width,
            "height": self._height,
            "test_frames": test_frames,
        }
        cameras = [frame["camera"] for frame in self._frames]
        if all(camera == cameras[0] for camera in cameras):
            index["camera"] = cameras[0]
            for frame in self._frames:
                del frame["camera"]
        index["frames"] = self._frames
        theta = np.stack(self._theta)
        _write_whole(self._root / THETA_FILE, lambda file: np.save(file, theta))
        text = json.dumps(index, indent=1).encode()
        _write_whole(self._root / INDEX_FILE, lambda file: file.write(text))
        return load_dataset(self._root)

    def _write_head(self) -> str:
        if isinstance(self._arrays, str):
            return self._arrays
        embedded = HeadArrays.embedded()
        if not (
            self._arrays.name == embedded.name
            and self._arrays.v_template.shape == embedded.v_template.shape
            and np.array_equal(self._arrays.shapedirs, embedded.shapedirs)
        ):
            self._arrays.save(self._root / HEAD_FILE)
        return self._arrays.name


def _write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write beside `path`, then move into place; a full disk is told as such."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            write(file)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UserError(
                f"There is no space left to write {path}.", "Free some space, or name another disk."
            ) from None
        raise
