"""The film that an avatar was trained on, with the theta that it was trained on."""

from dataclasses import replace
from pathlib import Path

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.storage.refined_frames import RefinedFrames, load_refined_frames
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.data.native.format import INDEX_FILE
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.export.run_data import dataset_folder
from rgbavatar_ns.head import is_same_identity


def as_trained_on(
    avatar: AvatarMethod, run_folder: Path, dataset: TrackedDataset, folder: Path
) -> TrackedDataset:
    """The dataset that was opened from `folder`, its theta as the run refined it.

    So the avatar's own film looks as `ns-eval` and `ns-viewer` show it. As tracked stay a run
    without refined tracking, a bundle, which knows no frames, another person's dataset or one of
    other frames, which only drives, and another system's data, whose import may put the head's
    motion elsewhere than the run's did. Raises UserError where the run's own dataset is not the one
    of then any more, and where the run cannot be read.
    """
    refined = load_refined_frames(run_folder) if (folder / INDEX_FILE).is_file() else None
    if refined is None:
        return dataset
    amiss = _misfit(avatar, refined, dataset)
    if amiss is None:
        place = {number: row for row, number in enumerate(refined.frame_index)}
        rows = [place[number] for number in dataset.frame_index]
        return replace(dataset, theta=refined.theta[rows])
    if folder.resolve() != dataset_folder(run_folder).resolve():
        return dataset
    raise UserError(
        f"{folder} is not as it was when {refined.path} refined its tracking: {amiss}.",
        "Name the data of then (--data), or train the avatar anew.",
    )


def _misfit(avatar: AvatarMethod, refined: RefinedFrames, dataset: TrackedDataset) -> str | None:
    """Why the refined theta is not of this dataset; None where it is."""
    if not is_same_identity(avatar.identity, dataset.identity):
        return "its person was measured otherwise"
    unknown = sorted(set(dataset.frame_index) - set(refined.frame_index))
    if unknown:
        return f"{len(unknown)} of its frames are not the run's ({first_few(unknown)})"
    if refined.theta.shape[1] != dataset.theta.shape[1]:
        return f"its theta has {dataset.theta.shape[1]} numbers, not {refined.theta.shape[1]}"
    return None
