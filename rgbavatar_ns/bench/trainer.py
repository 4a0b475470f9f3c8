"""nerfstudio's trainer against the bare step: the same frames in the same order, from one start."""

import copy
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch.utils import benchmark

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.storage.checkpoint_file import SUMMARY_NAME
from rgbavatar_ns.avatar.training import TrainingBatch, TrainingOptions, TrainingStep, fit
from rgbavatar_ns.avatar.training.batches import ChosenFrames, DeviceFrames
from rgbavatar_ns.avatar.training.cuda_graph import Recorder, record_cuda_graph
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.avatar.training.step import StepKind
from rgbavatar_ns.bench.options import StepOptions
from rgbavatar_ns.bench.scenes import DEFAULT_SIZE_PX, on_device
from rgbavatar_ns.bench.timing import Progress
from rgbavatar_ns.bench.workloads import read_images
from rgbavatar_ns.data import OfflineOrder, TrackedDataset, load_dataset
from rgbavatar_ns.files import written_json
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset

_SEED = 0


def bench_trainer(
    options: StepOptions, device: torch.device, progress: Progress | None = None
) -> dict[str, Any]:
    """Train an avatar twice, by nerfstudio's trainer and by bare steps, and compare their speeds.

    On --data or on a small demo subject, without colour initialisation. The trainer's speed is
    what it writes to training.json, its wait for the first pictures included.
    """
    tell = progress or (lambda what, done, total: None)
    with tempfile.TemporaryDirectory(prefix="rgbavatar-bench-") as folder:
        if options.data is None:
            size = options.size or DEFAULT_SIZE_PX
            demo = DemoConfig(image_size=size, num_frames=22, num_test_frames=2, seed=_SEED)
            dataset = make_demo_dataset(
                Path(folder) / "data", demo, lambda done, total: tell("demo subject", done, total)
            )
        else:
            dataset = load_dataset(options.data)
        config = _trainer_config(options, dataset, Path(folder))
        config.machine.device_type = device.type
        summary = _train(config)
        model, datamanager = config.pipeline.model, config.pipeline.datamanager
        batch = min(datamanager.batch_size, len(dataset.train))
        avatar = Avatar(HeadModel(dataset.arrays), dataset.identity, model.avatar, seed=_SEED)
        avatar = avatar.to(device)
        bare, kind = bare_images_per_second(
            avatar, dataset, batch, options.trainer_steps, tell, datamanager.device_mib
        )
    return {
        "images_per_second": summary["images_per_second"],
        "bare_images_per_second": bare,
        "bare_step": kind,
        "share_of_bare_step": summary["images_per_second"] / bare,
        "steps": summary["steps"],
        "batch": batch,
        "frames": len(dataset.train),
        "width_px": dataset.width,
        "height_px": dataset.height,
        "gaussians": avatar.num_gaussians,
    }


def _trainer_config(options: StepOptions, dataset: TrackedDataset, folder: Path) -> Any:
    """The method `rgbavatar` for a short run that leaves nothing behind."""
    from rgbavatar_ns.plugin.methods import rgbavatar

    config: Any = copy.deepcopy(rgbavatar.config)
    config.data = config.pipeline.datamanager.data = dataset.root
    config.pipeline.datamanager.batch_size = options.batch
    avatar = config.pipeline.model.avatar
    avatar = avatar if options.uv is None else replace(avatar, uv_resolution=options.uv)
    avatar = avatar if options.bases is None else replace(avatar, num_bases=options.bases)
    config.pipeline.model.avatar = avatar
    config.pipeline.model.initialize_colors = False
    config.output_dir, config.experiment_name, config.timestamp = folder / "runs", "bench", "run"
    config.vis, config.max_num_iterations = "tensorboard", options.trainer_steps
    config.machine.seed = _SEED
    return config


def _train(config: Any) -> dict[str, Any]:
    with warnings.catch_warnings():
        # nerfstudio's and torchvision's, about parts that are not used here.
        warnings.simplefilter("ignore")
        trainer = config.setup()
        trainer.setup()
        trainer.train()
    return written_json(trainer.base_dir / SUMMARY_NAME)


def bare_images_per_second(
    avatar: Avatar,
    dataset: TrackedDataset,
    batch: int,
    steps: int,
    tell: Progress,
    device_mib: int,
    recorder: Recorder = record_cuda_graph,
) -> tuple[float, StepKind]:
    """The speed of as many bare steps over the same batches, pictures at hand, and their kind.

    As in the trainer they are recorded where the device can do that and the frames fit into
    `device_mib`; the recording counts in both.
    """
    order, device = OfflineOrder(dataset.train, batch, _SEED), avatar.identity.device
    images = read_images(dataset, range(len(dataset)))
    fits = images.nbytes <= device_mib << 20

    def device_frames() -> DeviceFrames | None:
        frames = DeviceFrames(dataset.theta, dataset.cameras, images)
        return on_device(frames, device) if fits else None

    options = TrainingOptions(seed=_SEED, first_colors=None)
    step = TrainingStep(avatar, options=options, frames=device_frames, recorder=recorder)

    def batch_at(number: int) -> TrainingBatch | ChosenFrames:
        tell("bare steps beside the trainer", number, steps)
        chosen = order.batch(number)
        if step.kind == "recorded":
            return ChosenFrames(chosen, random_backgrounds(number, len(chosen), _SEED))
        cameras = dataset.cameras.select(chosen)
        return on_device(TrainingBatch(dataset.theta[chosen], cameras, images[chosen]), device)

    start = benchmark.timer()
    fit(step, batch_at, range(steps))
    return steps * batch / (benchmark.timer() - start), step.kind
