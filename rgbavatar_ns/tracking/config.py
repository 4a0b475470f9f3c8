"""What a user can choose when a video is tracked."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rgbavatar_ns.options import Between, CheckedOptions, Count, Counted


@dataclass(frozen=True)
class TrackConfig(CheckedOptions):
    """Options of `track_video`; the defaults suit a webcam or phone clip of one person."""

    image_size: Annotated[int, Between(16, 4096)] | None = None
    """Side of the square images of the dataset, pixels. None keeps the film's own, up to 512, where
    they are 400 or more, and else gives the head 256, and so more to what shows shoulders too."""
    test_frames: Counted | None = None
    """Last frames held out for evaluation; None holds out a fifth of the tracked frames,
    and one of two to four."""
    max_frames: Count | None = None
    """Read at most so many frames in all; None reads everything."""
    focal_px: Annotated[float, Between(1, 1e6)] | None = None
    """Focal length in pixels of the source frame, .25 to 50 times its longer side; None takes
    the head to be .9 to .95 m away. FaceMesh sees it as from about there wherever the camera is:
    the true focal length of a camera half a metre away makes a worse head."""
    identity_components: Annotated[int, Between(1, 1000)] = 30
    """How many identity components of the head model are fitted."""
    key_frames: Annotated[int, Between(1, 1000)] = 12
    """Frames that identity is fitted on."""
    head_only: bool = False
    """Make an avatar that ends at the neck, where the mattes fade out. By default it has shoulders
    and chest as far as they are filmed. Of your own head model (`flame`) only the head is made."""
    mattes: Path | None = None
    """Your own mattes, in place of those that are found: a folder with one image a frame (named
    like the frames, or in the order of their numbers; white or opaque is the person), or a mask
    video. The alpha channel of a folder of images is used by itself."""
    flame: Path | None = None
    """Track with your own FLAME (a pickle, or the folder that holds it) or with the head of a
    dataset (its npz file), in place of the embedded head. Where the face's landmarks lie on it is
    found by laying the embedded head over it."""
    temporal_weight: Annotated[float, Between(0, 1e4)] = 1.0
    """How strongly each frame is drawn to the mean of its neighbours; 0 switches it off."""
    overwrite: bool = False
    """Replace an existing dataset, or an unfinished run of other options, at the destination."""
