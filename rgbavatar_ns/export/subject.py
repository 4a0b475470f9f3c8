"""An avatar with what a command needs to know about it: its film, what it saw, how it is seen."""

import os
from dataclasses import dataclass
from pathlib import Path

from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.data.opening import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.own_film import as_trained_on
from rgbavatar_ns.export.run_data import dataset_folder, statistics_of
from rgbavatar_ns.export.views import front_camera, resized
from rgbavatar_ns.kernels import PinholeCameras

_SIDE_PX = 512
"""Of a picture where nothing says how large it should be."""


@dataclass(frozen=True)
class Subject:
    """An avatar and what is known about its training."""

    avatar: AvatarMethod
    dataset: TrackedDataset | None
    """Where its film is shown, with the theta that the avatar was trained on (`as_trained_on`)."""
    seen: TrainingStatistics
    camera: PinholeCameras
    """The dataset's first camera, or one before the face, for pictures of the size asked for."""
    lost: Path | None = None
    """Where the run's own dataset was, if nothing is there."""


def load_subject(
    run_folder: Path,
    data: Path | None,
    width: int | None = None,
    height: int | None = None,
    *,
    film: bool = True,
) -> Subject:
    """Load an avatar from a run, a checkpoint or a bundle, with its dataset if it names one.

    data: the dataset in place of the run's own, which may be gone where the avatar knows what it
    saw. film: whether its own film is shown, then with the theta that the avatar was trained on,
    and not only its camera is wanted. Raises UserError where the avatar or its dataset cannot be
    read or do not fit, and for a bundle that knows nothing about its training.
    """
    avatar = load_avatar(run_folder)
    seen = avatar.training_statistics
    folder = dataset_folder(run_folder) if data is None else data
    if data is None and folder == run_folder:
        if seen is None:
            raise UserError(f"{run_folder} does not name its dataset.", "Name it with --data.")
        return Subject(avatar, None, seen, _before_the_face(avatar, width, height))
    if data is None and seen is not None and not os.path.exists(folder):
        return Subject(avatar, None, seen, _before_the_face(avatar, width, height), lost=folder)
    dataset = load_dataset(folder)
    avatar.require_layout(dataset.layout, f"The dataset {folder}")
    if film:
        dataset = as_trained_on(avatar, run_folder, dataset, folder)
    camera = resized(dataset.cameras.select([0]), width or dataset.width, height or dataset.height)
    return Subject(avatar, dataset, seen or statistics_of(avatar, dataset), camera)


def _before_the_face(avatar: AvatarMethod, width: int | None, height: int | None) -> PinholeCameras:
    return front_camera(avatar, width or _SIDE_PX, height or _SIDE_PX)


def told_lost(subject: Subject) -> str | None:
    """What to tell of a film that is gone; None where it is not."""
    if subject.lost is None:
        return None
    return (
        f"note: the run's own data, {subject.lost}, is not there. It goes without its frames and "
        "camera; --data names where they are now."
    )
