"""The theta that a run with refined tracking was trained on, as its checkpoint keeps it."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.storage.bundle import load_any
from rgbavatar_ns.avatar.storage.stored_avatar import StoredAvatar
from rgbavatar_ns.reading import DamagedFileError


@dataclass(frozen=True)
class RefinedFrames:
    """Theta of all frames of the run's dataset: corrected where trained on, else calibrated."""

    path: Path
    """The checkpoint that it is of."""
    theta: Float[Tensor, "F H"]
    frame_index: tuple[int, ...]
    """Which frame of the source each is."""

    @classmethod
    def of_stored(cls, stored: StoredAvatar) -> "RefinedFrames | None":
        """What an avatar's file holds; None without refined tracking. UserError if damaged."""
        frames = stored.refined_frames
        if frames is None:
            return None
        with stored.damage_told():
            theta, index = frames["theta"], frames["index"]
            whole = isinstance(theta, Tensor) and theta.ndim == 2 and theta.is_floating_point()
            if not whole or not bool(torch.isfinite(theta).all()):
                raise DamagedFileError("its frames have no theta, or impossible numbers there")
            listed = isinstance(index, list) and all(type(number) is int for number in index)
            if not listed or len(set(index)) != len(theta) or len(index) != len(theta):
                raise DamagedFileError("its frames are numbered otherwise than their theta")
            return cls(stored.path, theta.float(), tuple(index))


def load_refined_frames(path: Path) -> RefinedFrames | None:
    """The frames of an avatar's file, if its tracking was refined; raises UserError as `load_any`.

    A bundle knows no frames.
    """
    return RefinedFrames.of_stored(load_any(path))
