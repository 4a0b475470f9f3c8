"""What a user can choose when a video is tracked."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrackConfig:
    """Options of `track_video`; the defaults suit a webcam or phone clip of one person."""

    image_size: int = 256
    """Side of the square images of the dataset, pixels."""
    test_frames: int | None = None
    """Last frames held out for evaluation; None holds out a fifth of the tracked frames."""
    max_frames: int | None = None
    """Read at most so many frames in all; None reads everything."""
    focal_px: float | None = None
    """Focal length in pixels of the source frame; None estimates it."""
    identity_components: int = 30
    """How many identity components of the head model are fitted."""
    key_frames: int = 12
    """Frames that identity and focal length are fitted on."""
    keep_torso: bool = False
    """Keep neck and shoulders as the matte found them. By default the matte fades out below the
    neck of the fitted head, because the avatar's Gaussians ride on a mesh that ends there: a
    torso in the image would be explained by stretched Gaussians that swing with the head."""
    mattes: Path | None = None
    """Your own mattes, in place of those that are found: a folder with one image a frame (named
    like the frames, or in the order of their numbers; white or opaque is the person), or a mask
    video. The alpha channel of a folder of images is used by itself."""
    flame: Path | None = None
    """Track with your own FLAME (a pickle, or the folder that holds it) or with the head of a
    dataset (its npz file), in place of the embedded head. Where the face's landmarks lie on it is
    found by laying the embedded head over it."""
    temporal_weight: float = 1.0
    """How strongly each frame is drawn to the mean of its neighbours; 0 switches it off."""
    overwrite: bool = False
    """Replace an existing dataset, or an unfinished run of other options, at the destination."""
