"""Batches of whole frames for nerfstudio's pipeline, decoded in the background."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.base_datamanager import DataManager
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader
from rich.progress import track
from torch.nn import Parameter

from rgbavatar_ns.avatar.methods.loss_terms import SSIM_WINDOW_PX
from rgbavatar_ns.avatar.prior import NUM_VIEWS
from rgbavatar_ns.avatar.training.batches import ChosenFrames, DeviceFrames
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.data import ImageCache, OfflineOrder, TrackedDataset
from rgbavatar_ns.data.check import quick_check
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Between, Counted, Seed
from rgbavatar_ns.plugin.cameras import from_nerfstudio
from rgbavatar_ns.plugin.dataparser import (
    FrameDataset,
    RGBAvatarDataParser,
    RGBAvatarDataParserConfig,
)
from rgbavatar_ns.plugin.errors import install_user_error_hook
from rgbavatar_ns.plugin.film_path import FilmCameras, FilmPath

_MIB = 1 << 20
_DECODED_TOGETHER = 32


@dataclass
class RGBAvatarDataManagerConfig(FullImageDatamanagerConfig):
    """Batches of different frames of one dataset.

    nerfstudio's `ns-render dataset` insists on a relative of its own full-image config; what
    that config has and this one does not use is kept off the command line.
    """

    _target: type = field(default_factory=lambda: RGBAvatarDataManager)
    data: Path | None = None
    """Dataset folder; `--data` sets it."""
    reader: tyro.conf.Positional[Literal["rgbavatar-data"]] = "rgbavatar-data"
    """What reads the folder, under the name that other methods call it by; may be left out."""
    dataparser: RGBAvatarDataParserConfig = field(default_factory=RGBAvatarDataParserConfig)
    """How the folder is read."""
    batch_size: Annotated[int, Between(1, 4096)] = 10
    """Frames a step, all different (paper: 10)."""
    cache_mib: Counted = 1024
    """Budget for decoded images in MiB; what does not fit is decoded again when it is needed."""
    decoding_threads: Annotated[int, Between(1, 256)] = 2
    """Background threads that decode images."""
    prefetch_steps: Annotated[int, Between(0, 1000)] = 2
    """Steps whose images are decoded ahead."""
    device_mib: Counted = 16384
    """Budget for training images on a GPU in MiB, and at most half of what is free there; where all
    fit, it takes whole steps by itself."""
    check_data: bool = True
    """Refuse data whose head is not where its images show it (`rgbavatar check`), before the first
    step."""
    seed: Seed | None = None
    """Seed of frame order and backgrounds; by default that of the run, `--machine.seed`."""
    masks_on_gpu: tyro.conf.Suppress[bool] = False
    images_on_gpu: tyro.conf.Suppress[bool] = False
    camera_res_scale_factor: tyro.conf.Suppress[float] = 1.0
    eval_num_images_to_sample_from: tyro.conf.Suppress[int] = -1
    eval_num_times_to_repeat_images: tyro.conf.Suppress[int] = -1
    eval_image_indices: tyro.conf.Suppress[tuple[int, ...] | None] = None
    cache_images: tyro.conf.Suppress[Literal["cpu", "gpu"]] = "cpu"
    cache_images_type: tyro.conf.Suppress[Literal["uint8", "float32"]] = "uint8"
    max_thread_workers: tyro.conf.Suppress[int | None] = None
    train_cameras_sampling_strategy: tyro.conf.Suppress[Literal["random", "fps"]] = "random"
    train_cameras_sampling_seed: tyro.conf.Suppress[int] = 0
    fps_reset_every: tyro.conf.Suppress[int] = 100

    def require_trainable(self) -> None:
        """Raise UserError where there is no dataset, or one that no run can train on."""
        parsed = self.dataparser if self.data is None else replace(self.dataparser, data=self.data)
        self.check(parsed.setup().tracked)

    def check(self, tracked: TrackedDataset) -> None:
        """Raise UserError for pictures that losses cannot compare, or a head beside its images."""
        _require_room_for_ssim(tracked)
        if self.check_data:
            for problem in quick_check(tracked):
                raise problem.as_error()


class RGBAvatarDataManager(DataManager):
    """Serves frames as (nerfstudio cameras with theta, uint8 RGBA images).

    Training frames come in batches of different frames through the image cache; held-out frames
    come in batches for the evaluation loss and singly for metrics.
    """

    config: RGBAvatarDataManagerConfig
    train_dataset: FrameDataset
    eval_dataset: FrameDataset
    train_dataparser_outputs: DataparserOutputs

    def __init__(
        self,
        config: RGBAvatarDataManagerConfig,
        device: torch.device | str = "cpu",
        test_mode: Literal["test", "val", "inference", "train"] = "val",
        world_size: int = 1,
        local_rank: int = 0,
        **_: Any,
    ) -> None:
        install_user_error_hook()
        self.config = config
        self.seed = 0 if config.seed is None else config.seed
        self.device = device
        self.test_mode = test_mode
        self.test_split = "val" if test_mode == "val" else "test"
        self.world_size = world_size
        self.local_rank = local_rank
        if config.data is not None:
            config.dataparser.data = Path(config.data)
        self.dataparser: RGBAvatarDataParser = config.dataparser.setup()
        self.includes_time = self.dataparser.includes_time
        tracked = self.dataparser.tracked
        if test_mode == "val":
            config.check(tracked)
        self.film_path = FilmPath(len(tracked), tracked.train)
        self.train_dataparser_outputs = self.dataparser.get_dataparser_outputs("train")
        self.train_dataset = self._dataset("train", self.train_dataparser_outputs)
        self.eval_dataset = self._dataset(
            "test", self.dataparser.get_dataparser_outputs(self.test_split)
        )
        super().__init__()

    def _dataset(self, split: str, outputs: DataparserOutputs) -> FrameDataset:
        positions = self.dataparser.positions(split)
        dataset = FrameDataset(outputs, self.dataparser.tracked, positions)
        dataset.cameras = FilmCameras.of(dataset.cameras, positions, self.film_path)
        return dataset

    def setup_train(self) -> None:
        """Put the frame order in place, a function of seed and step: resuming needs no state."""
        rows = range(len(self.train_dataset))
        self._train_order = OfflineOrder(rows, min(self.config.batch_size, len(rows)), self.seed)
        self._train_cameras = self.train_dataset.cameras.to(self.device)

    def setup_eval(self) -> None:
        """Put the order of the held-out frames in place, if there are any."""
        rows = range(len(self.eval_dataset))
        if not rows:
            return
        self._eval_order = OfflineOrder(rows, min(self.config.batch_size, len(rows)), 0)
        self._eval_cameras = self.eval_dataset.cameras.to(self.device)

    @cached_property
    def image_cache(self) -> ImageCache:
        """Decoded images of the whole dataset, within the budget."""
        return ImageCache(
            self.dataparser.tracked,
            self.config.cache_mib * _MIB,
            num_workers=self.config.decoding_threads,
        )

    def next_train(self, step: int) -> tuple[Cameras, dict[str, Any]]:
        """Cameras, images and backgrounds of the training frames of `step`, a function of it."""
        positions = self.dataparser.positions("train")
        batch = self._batch(self._train_order.batch(step), self._train_cameras, positions, step)
        for ahead in range(1, self.config.prefetch_steps + 1):
            rows = self._train_order.batch(step + ahead)
            self.image_cache.prefetch([positions[row] for row in rows])
        return batch

    def every_train(self) -> Iterator[tuple[Cameras, dict[str, Any]]]:
        """All training frames once, in the form of training batches."""
        positions, size = self.dataparser.positions("train"), self.config.batch_size
        for number, first in enumerate(range(0, len(positions), size)):
            rows = list(range(first, min(first + size, len(positions))))
            yield self._batch(rows, self._train_cameras, positions, number)

    def device_frames(self) -> DeviceFrames | None:
        """All training frames on the device; None without any, or beyond the budget.

        Behind them there is room for the surface prior's views: a second copy of all images would
        go beyond the budget.
        """
        positions = self.dataparser.positions("train")
        if not positions:
            return None
        tracked = self.dataparser.tracked
        each, rows = tracked.width * tracked.height * 4, len(positions) + NUM_VIEWS
        if rows * each > device_budget(self.config.device_mib * _MIB, self.device):
            return None
        shape = (rows, tracked.height, tracked.width, 4)
        room = torch.empty(shape, dtype=torch.uint8, device=self.device)
        chunks = range(0, len(positions), _DECODED_TOGETHER)
        for first in track(chunks, "Images to the device...", transient=True):
            chosen = positions[first : first + _DECODED_TOGETHER]
            room[first : first + len(chosen)] = self.image_cache.get(chosen).to(self.device)
        theta = (self._train_cameras.metadata or {})["theta"].to(self.device)
        cameras = from_nerfstudio(self._train_cameras)
        return DeviceFrames(theta, cameras, room[: len(positions)], room)

    def next_choice(self, step: int) -> ChosenFrames:
        """The frames of `step` among the training frames, the same as `next_train` shows."""
        rows = self._train_order.batch(step)
        return ChosenFrames(rows, random_backgrounds(step, len(rows), self.seed))

    def next_eval(self, step: int) -> tuple[Cameras, dict[str, Any]]:
        """Some held-out frames, in the same form as a training batch."""
        positions = self.dataparser.positions(self.test_split)
        return self._batch(self._eval_order.batch(step), self._eval_cameras, positions, step)

    def _batch(
        self, rows: list[int], cameras: Cameras, places: Sequence[int], step: int
    ) -> tuple[Cameras, dict[str, Any]]:
        """A split's frames, by rows of its cameras; `places` are its positions in the dataset.

        Every image has a background colour of its own (paper, sec. 3.2), which its camera brings
        to the model.
        """
        positions = [places[row] for row in rows]
        images = self.image_cache.get(positions).to(self.device)
        chosen = cameras[torch.tensor(rows, device=self.device)]
        background = random_backgrounds(step, len(rows), self.seed).to(self.device)
        chosen.metadata = {**(chosen.metadata or {}), "background": background}
        return chosen, {"image": images, "position": positions, "step": step}

    def next_eval_image(self, step: int) -> tuple[Cameras, dict[str, Any]]:
        """One held-out frame: its camera, and its picture over black [H, W, 3]."""
        return self.eval_dataloader.get_camera(self._eval_order.batch(step)[0])

    @cached_property
    def eval_dataloader(self) -> FixedIndicesEvalDataloader:
        """Every held-out frame in order."""
        return FixedIndicesEvalDataloader(self.eval_dataset, device=self.device)

    @property
    def fixed_indices_eval_dataloader(self) -> FixedIndicesEvalDataloader:
        """Every held-out frame in order; the name that nerfstudio's evaluation asks for."""
        return self.eval_dataloader

    def get_train_rays_per_batch(self) -> int:
        """Pixels of a training batch."""
        tracked = self.dataparser.tracked
        return min(self.config.batch_size, len(tracked.train)) * tracked.width * tracked.height

    def get_eval_rays_per_batch(self) -> int:
        """Pixels of an evaluation batch."""
        tracked = self.dataparser.tracked
        return min(self.config.batch_size, len(tracked.test)) * tracked.width * tracked.height

    def get_datapath(self) -> Path:
        """The dataset's folder, beside which the viewer keeps camera paths."""
        return self.config.dataparser.data or Path()

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Nothing here is learnt."""
        return {}


def _require_room_for_ssim(tracked: TrackedDataset) -> None:
    """Refuse pictures that neither losses nor scores could compare, before they are trained on."""
    if min(tracked.width, tracked.height) < SSIM_WINDOW_PX:
        raise UserError(
            f"The images of {tracked.root} have {tracked.width} x {tracked.height} pixels, fewer "
            f"than the {SSIM_WINDOW_PX} a side that SSIM compares.",
            "Make the dataset again with larger images.",
        )


def device_budget(most: int, device: torch.device | str) -> int:
    """Bytes of a device's memory that images may take, `most` at most.

    Half of what is free there: the rest is for the avatar, its gradients and the kernels' lists.
    """
    if torch.device(device).type != "cuda":
        return most
    free, _ = torch.cuda.mem_get_info(device)
    return min(most, free // 2)
