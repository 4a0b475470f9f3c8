"""What can be chosen when another tracker's data is read."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import CheckedOptions, Counted

HeadPose = Literal["source", "camera", "head", "neck"]
Region = Literal["person", "head"]
Progress = Callable[[str, int, int], None]
"""Called with (stage, done, in all)."""


@dataclass(frozen=True)
class ImportOptions(CheckedOptions):
    """How a folder of another system is read; the defaults are as that system reads it."""

    format: str | None = None
    """Name of the format (see `rgbavatar import --help`); by default the folder tells it."""
    flame: Path | None = None
    """FLAME pickle, or the folder that holds it; the environment variable RGBAVATAR_FLAME by
    default."""
    flame_version: str | None = None
    """Version of FLAME that the data was tracked with, where it is not the format's usual one."""
    flame_uv: Path | None = None
    """UV map of FLAME (npz or OBJ); by default what lies beside the pickle."""
    flame_eyelids: Path | None = None
    """Folder of l_eyelid.npy and r_eyelid.npy; by default beside the pickle."""
    teeth: bool = True
    """Whether FLAME gets teeth."""
    head_pose: HeadPose | Literal["auto"] = "auto"
    """Where the head's motion goes. source: as the format has it; camera: all of it into the
    camera; head: one still camera, and the head turns and moves; neck: the same, but the rotation
    is the neck's, so that the collar stays upright; auto: head where the format has it all in one
    camera (metrical-tracker and its kin), else source. What an avatar looks like may depend on how
    the head is turned, but not on where the camera is."""
    region: Region = "person"
    """person: the format's own mattes; head: of FlashAvatar data only what its parsing masks call
    head, neck and mouth."""
    images: Path | None = None
    """Folder of the images, for metrical-tracker's data and VHAP's raw output; from where you
    stand, not from the data."""
    masks: Path | None = None
    """Folder of their mattes, likewise; by default what lies in the data."""
    test_frames: Counted | None = None
    """Hold out this many frames at the end instead of those that the format holds out."""
    test_cameras: tuple[str, ...] = ()
    """Hold out these cameras instead of what the format holds out."""
    allow_partial: bool = False
    """Leave out frames that cannot be used, instead of refusing them all."""
    allow_opaque: bool = False
    """Take images that have no matte, background and all."""
    allow_outside: bool = False
    """Follow links and paths that lead out of the folder."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.test_frames is not None and self.test_cameras:
            raise UserError(
                "Both a count of frames and cameras are named to be held out.", "Name one of them."
            )
