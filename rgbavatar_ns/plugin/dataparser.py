"""nerfstudio's view of a dataset: the project's own, or another system's.

nerfstudio's list of dataparsers, which its datamanagers import, loads this module by its entry
point: nothing here may import a datamanager.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import tyro
from jaxtyping import Float
from nerfstudio.data.dataparsers.base_dataparser import (
    DataParser,
    DataParserConfig,
    DataparserOutputs,
)
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from torch import Tensor

from rgbavatar_ns.data import TrackedDataset, load_dataset
from rgbavatar_ns.data.importers import ImportOptions
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, ThetaLayout
from rgbavatar_ns.plugin.cameras import to_nerfstudio
from rgbavatar_ns.plugin.errors import install_user_error_hook

_SCENE_RADIUS_M = 0.5


@dataclass(frozen=True)
class FilmedSubject:
    """What the model needs to know of a dataset: the head and every frame's theta."""

    arrays: HeadArrays
    identity: Float[Tensor, "I"]
    layout: ThetaLayout
    theta: Float[Tensor, "F H"]
    frame_index: tuple[int, ...]
    train: tuple[int, ...]
    """Positions of the training frames."""
    world_to_camera: Float[Tensor, "F 4 4"]

    def __deepcopy__(self, memo: dict[int, Any]) -> "FilmedSubject":
        """nerfstudio copies metadata deeply; nothing here is ever changed, so share it."""
        return self


@dataclass
class RGBAvatarDataParserConfig(DataParserConfig):
    """Reads a dataset folder of `rgbavatar track`, `rgbavatar demo-data` or another system."""

    _target: type = field(default_factory=lambda: RGBAvatarDataParser)
    data: Path | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Folder that holds dataset.json, or another system's data."""
    importing: ImportOptions = field(default_factory=ImportOptions)
    """How another system's data is read."""
    downscale_factor: tyro.conf.Suppress[float | None] = None
    """Set by `ns-render dataset --downscale-factor`, and refused."""


class RGBAvatarDataParser(DataParser):
    """Splits a tracked dataset into training frames and the held-out ones.

    `train` are the training frames; `val` and `test` are the held-out ones.
    """

    config: RGBAvatarDataParserConfig
    includes_time: bool = True

    def __init__(self, config: RGBAvatarDataParserConfig) -> None:
        install_user_error_hook()
        super().__init__(config)
        if config.downscale_factor not in (None, 1):
            raise UserError(
                f"--downscale-factor is {config.downscale_factor:g}, but frames of this method are "
                "drawn in the size that they were filmed in.",
                "Leave it out; `ns-render interpolate` takes it.",
            )
        self._tracked: TrackedDataset | None = None

    @property
    def tracked(self) -> TrackedDataset:
        """The dataset, validated and read on first use; raises UserError on any problem."""
        if self._tracked is None:
            if self.config.data is None:
                raise UserError(
                    "No dataset was named.",
                    "Pass --data FOLDER; `rgbavatar demo-data FOLDER` makes one to try.",
                )
            self._tracked = load_dataset(self.config.data, self.config.importing)
        return self._tracked

    def positions(self, split: str) -> tuple[int, ...]:
        """Positions in the dataset of the frames of nerfstudio's `split`."""
        return self.tracked.train if split == "train" else self.tracked.test

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        tracked, positions = self.tracked, self.positions(split)
        chosen = torch.tensor(positions, dtype=torch.long)
        cameras = tracked.cameras
        every_frame = to_nerfstudio(
            cameras,
            theta=tracked.theta,
            position=torch.arange(len(tracked), dtype=torch.float32)[:, None],
            times=torch.linspace(0.0, 1.0, len(tracked)),
        )
        radius = _SCENE_RADIUS_M
        return DataparserOutputs(
            image_filenames=[tracked.image_paths[position] for position in positions],
            cameras=every_frame[chosen],
            alpha_color=torch.zeros(3),
            scene_box=SceneBox(aabb=torch.tensor([[-radius] * 3, [radius] * 3])),
            metadata={
                "subject": FilmedSubject(
                    arrays=tracked.arrays,
                    identity=tracked.identity,
                    layout=tracked.layout,
                    theta=tracked.theta,
                    frame_index=tuple(tracked.frame_index),
                    train=tuple(tracked.train),
                    world_to_camera=cameras.world_to_camera.expand(len(tracked), 4, 4),
                )
            },
        )


rgbavatar_data = DataParserSpecification(
    config=RGBAvatarDataParserConfig(),
    description="Tracked heads of rgbavatar_ns and of the systems that it reads.",
)
"""For other methods, which see the cameras, and the images over black."""


class FrameDataset(InputDataset):
    """Single frames for evaluation, rendering and the viewer: RGB over black, in [0, 1]."""

    def __init__(
        self, outputs: DataparserOutputs, tracked: TrackedDataset, positions: tuple[int, ...]
    ) -> None:
        super().__init__(outputs)
        self._tracked = tracked
        self._positions = positions

    def get_numpy_image(self, image_idx: int) -> npt.NDArray[np.uint8]:
        """RGBA of one frame [H, W, 4]; raises UserError on a broken file or another size."""
        return np.asarray(self._tracked.read_image(self._positions[image_idx]))

    def get_metadata(self, data: dict[str, Any]) -> dict[str, Any]:
        """The frame as it was read, uint8 RGBA [H, W, 4], beside nerfstudio's over black."""
        return {"image_rgba": torch.from_numpy(self.get_numpy_image(data["image_idx"]))}
