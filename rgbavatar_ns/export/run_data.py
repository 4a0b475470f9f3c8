"""Which dataset a run of ns-train was trained on, without nerfstudio, and what was seen in it."""

import os
from pathlib import Path

import torch
import yaml

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.storage.checkpoint_file import CONFIG_NAME, MODELS_FOLDER, newest_run
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.reading import DamagedFileError, damage_told, read_file

_MOST_BYTES = 1 << 18
"""nerfstudio's has 10 kB, and a longer one takes seconds."""


def dataset_folder(path: Path) -> Path:
    """The dataset folder itself, or the one that a run's config names.

    Of an experiment's folder its newest run counts; of a run that a camera or a socket fed, what it
    recorded itself. Raises UserError where the path is none of these.
    """
    folder = newest_run(path) if os.path.isdir(path) else path.parent
    if folder.name == MODELS_FOLDER:
        folder = folder.parent
    config = folder / CONFIG_NAME
    if not os.path.exists(config):
        return path
    try:
        content = read_file(config, _MOST_BYTES)
        with damage_told():
            # The base loader knows no tags and no merging: plain lists, mappings and texts.
            described = yaml.load(content, yaml.BaseLoader)
            manager = described["pipeline"]["datamanager"]
            # Each may name it; the first that does is the one that was read. A path without parts
            # is the folder that the run was started in, and earlier runs' word for none.
            named = (manager["dataparser"]["data"], manager["data"], described["data"])
            paths = [parts for parts in named if isinstance(parts, list)]
            for parts in sorted(paths, key=lambda parts: not parts):
                if all(isinstance(part, str) for part in parts):
                    return Path(*parts)
            recorded = manager.get("recorded")
            if isinstance(recorded, list) and recorded and isinstance(recorded[-1], str):
                # Within the run's own folder, wherever that lies now.
                return folder / recorded[-1]
            raise KeyError("data")
    except DamagedFileError as error:
        raise UserError(
            f"{config} does not say which dataset was trained on: {error}.",
            "Name the dataset's folder instead.",
        ) from None


@torch.no_grad()
def statistics_of(avatar: AvatarMethod, dataset: TrackedDataset) -> TrainingStatistics:
    """Statistics over the dataset's training frames, with the avatar's own weights psi.

    Raises UserError where the dataset's theta does not fit the avatar.
    """
    avatar.require_layout(dataset.layout, f"The dataset {dataset.root}")
    theta = dataset.theta[list(dataset.train)]
    psi = avatar.weights(theta.to(avatar.identity.device)).cpu()
    views = dataset.cameras.world_to_camera[list(dataset.train)]
    names = avatar.head.arrays.expression_names
    return TrainingStatistics.of(theta, psi, avatar.layout, views, names)
