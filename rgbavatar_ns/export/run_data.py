"""Which dataset a run of ns-train was trained on, without nerfstudio, and what was seen in it."""

from pathlib import Path
from typing import Any

import torch
import yaml

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.errors import UserError

_CONFIG = "config.yml"


class _PlainLoader(yaml.SafeLoader):
    """Reads nerfstudio's config as plain lists and mappings; builds no Python object."""


def _as_plain(loader: yaml.SafeLoader, _suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return node.value


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _as_plain)


def dataset_folder(path: Path) -> Path:
    """The dataset folder itself, or the one that a run's config names.

    Raises UserError where the path is neither.
    """
    folder = path if path.is_dir() else path.parent
    if folder.name == "nerfstudio_models":
        folder = folder.parent
    config = folder / _CONFIG
    if not config.exists():
        return path
    try:
        described = yaml.load(config.read_text(encoding="utf-8"), _PlainLoader)
        manager = described["pipeline"]["datamanager"]
        # Each may name it; the first that does is the one that was read.
        for parts in (manager["dataparser"]["data"], manager["data"], described["data"]):
            if parts:
                return Path(*parts)
        raise KeyError("data")
    except (OSError, yaml.YAMLError, KeyError, TypeError) as error:
        raise UserError(
            f"{config} does not say which dataset was trained on: {error!r}.",
            "Name the dataset's folder instead.",
        ) from None


@torch.no_grad()
def statistics_of(avatar: Avatar, dataset: TrackedDataset) -> TrainingStatistics:
    """Statistics over the dataset's training frames, with the avatar's own weights psi.

    Raises UserError where the dataset's theta does not fit the avatar.
    """
    avatar.require_layout(dataset.layout, f"The dataset {dataset.root}")
    theta = dataset.theta[list(dataset.train)]
    psi = avatar.weights(theta.to(avatar.identity.device)).cpu()
    return TrainingStatistics.of(theta, psi, avatar.layout)
