"""nerfstudio's pipeline with this method's data and model, and LPIPS at evaluation."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from rich.progress import track
from torch import Tensor

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.metrics import LPIPSMetric, evaluate_images, mean_scores, with_sharpness
from rgbavatar_ns.avatar.training.batches import ChosenFrames, TrainingBatch
from rgbavatar_ns.avatar.training.cuda_graph import Recorder, record_cuda_graph
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.avatar.training.orthogonality import orthogonality_error
from rgbavatar_ns.avatar.training.step import StepKind, TrainingStep
from rgbavatar_ns.avatar.training.theta_fit import fit_theta
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import available_backends
from rgbavatar_ns.plugin.avatar_model import AvatarModel, AvatarModelConfig
from rgbavatar_ns.plugin.cameras import as_perspective, from_nerfstudio, is_perspective
from rgbavatar_ns.plugin.datamanager import RGBAvatarDataManager, RGBAvatarDataManagerConfig
from rgbavatar_ns.plugin.model import RGBAvatarModelConfig
from rgbavatar_ns.plugin.option_order import led_by
from rgbavatar_ns.plugin.viewer.panel import ViewerPanel

Evaluated = Callable[[int, Mapping[str, Any]], None]
"""Told of the scores of all held-out frames after a step of training."""


@led_by("model", "datamanager")
@dataclass
class RGBAvatarPipelineConfig(VanillaPipelineConfig):
    """Where the data comes from and what is trained on it."""

    _target: type = field(default_factory=lambda: RGBAvatarPipeline)
    datamanager: RGBAvatarDataManagerConfig = field(default_factory=RGBAvatarDataManagerConfig)
    """The data."""
    model: AvatarModelConfig = field(default_factory=RGBAvatarModelConfig)
    """The model."""


class RGBAvatarPipeline(VanillaPipeline):
    """Adds to nerfstudio's pipeline what `ns-eval` reports about LPIPS."""

    config: RGBAvatarPipelineConfig
    datamanager: RGBAvatarDataManager
    _model: AvatarModel
    recorder: Recorder = staticmethod(record_cuda_graph)
    """How a step becomes one that the device takes by itself."""

    def __init__(
        self, config: RGBAvatarPipelineConfig, device: str | torch.device, **more: Any
    ) -> None:
        if more.get("test_mode", "val") != "val":
            config, device = to_look_at(config, str(device))
        super().__init__(config, str(device), **more)
        self.viewer_panel = ViewerPanel(self.model, self.film)
        self.model.view = self._view
        self.evaluated: Evaluated = lambda step, metrics: None

    @property
    def model(self) -> AvatarModel:
        """The model; this method trains on one device, so it is never wrapped."""
        return self._model

    def _view(self, camera: Cameras, cropped: bool) -> dict[str, Tensor]:
        """Draw a camera without theta: what the viewer's user has chosen, or the film's moment.

        The viewer's crop box is passed over; a camera path that brings one is a UserError.
        """
        if self.viewer_panel.attached:
            time = None if camera.times is None else float(camera.times.reshape(-1)[0])
        elif cropped:
            raise UserError(
                "The camera path has a crop box, and this method draws whole avatars.",
                "Switch off 'Enable' under 'Crop Viewport' in the viewer and save the path again, "
                'or put "crop": null into the file.',
            )
        else:
            time = self.datamanager.film_path.moment(camera)
        if self.viewer_panel.attached and not is_perspective(camera):
            # An error would end the browser's thread.
            self.viewer_panel.tell("Other cameras than perspective ones are shown as if they were.")
            camera = as_perspective(camera)
        return self.viewer_panel.draw(from_nerfstudio(camera), time)

    def training_step(self, optimizers: Optimizers) -> TrainingStep | MethodStep:
        """The step that trains the model, for a run."""
        groups = {name: group["optimizer"] for name, group in optimizers.config.items()}
        norms = {name: group.max_norm for name, group in groups.items()}
        return self.model.training_step(
            optimizers.optimizers.values(),
            {name: norm for name, norm in norms.items() if norm is not None},
            self.datamanager.device_frames,
            self.recorder,
        )

    @property
    def film(self) -> TrackedDataset | None:
        """What the viewer compares the avatar with."""
        return self.datamanager.dataparser.tracked

    def training_batch(self, step: int, kind: StepKind) -> TrainingBatch | ChosenFrames:
        """What `step` is taken on; where steps are recorded, frames that lie on the device."""
        if kind == "recorded":
            return self.datamanager.next_choice(step)
        return _as_batch(*self.datamanager.next_train(step))

    def training_frames(self) -> Iterator[TrainingBatch]:
        """All frames that there are to train on, once, in batches."""
        for cameras, batch in self.datamanager.every_train():
            yield _as_batch(cameras, batch)

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Means over the held-out frames, with their sharpness against the film's.

        Under `ns-eval` these contain LPIPS, or under `lpips_unavailable` the reason why not, and
        with `refine_held_out` the scores of frames fitted to their images, named `..._refined`;
        `e_orth` is how far the bases are from orthogonal.

        Raises:
            UserError: the dataset holds out no frames.
        """
        if len(self.datamanager.eval_dataset) == 0:
            raise UserError(
                f"The dataset {self.datamanager.get_datapath()} holds out no frames.",
                "Write it again with some held out, so that there is something to evaluate on.",
            )
        if self.test_mode != "test":
            metrics = super().get_average_eval_image_metrics(step, output_path, get_std)
            metrics = with_sharpness(metrics)
            if step is not None:
                self.evaluated(step, metrics)
            return metrics
        if self.config.model.lpips_metric:
            self.model.lpips_metric = LPIPSMetric()
        metrics = super().get_average_eval_image_metrics(step, output_path, get_std)
        metrics = with_sharpness(metrics)
        if self.config.model.refine_held_out > 0:
            metrics |= self._refined_metrics()
        if isinstance(self.model.avatar, Avatar):
            metrics["e_orth"] = orthogonality_error(self.model.avatar.blendshapes).item()
        lpips = self.model.lpips_metric
        if lpips is None:
            metrics["lpips_unavailable"] = "switched off with --pipeline.model.lpips-metric False"
        elif lpips.unavailable is not None:
            metrics["lpips_unavailable"] = lpips.unavailable
        return metrics

    def get_average_image_metrics(self, *given: Any, **named: Any) -> dict[str, Any]:
        """As nerfstudio's, but scores that some frames have not are the mean of the others'."""
        self.model.scores.clear()
        metrics = super().get_average_image_metrics(*given, **named)
        spreads = [name for name in metrics if name.endswith("_std") and math.isnan(metrics[name])]
        metrics |= mean_scores(self.model.scores)
        # Of a single frame, or of scores that are missing: JSON knows no NaN.
        return {name: value for name, value in metrics.items() if name not in spreads}

    @torch.no_grad()
    def _refined_metrics(self) -> dict[str, float]:
        """Means over held-out frames whose theta was fitted to the image, the avatar frozen."""
        tracked, model = self.datamanager.dataparser.tracked, self.config.model
        size, scores = self.datamanager.config.batch_size, list[dict[str, float]]()
        count = len(tracked.test)
        fitted = min(model.refine_held_out_frames or count, count)
        every = torch.linspace(0, count - 1, fitted).round().long()
        for rows in track(every.split(size), "Fitting held-out frames..."):
            chosen = [tracked.test[row] for row in rows.tolist()]
            cameras = self.datamanager.eval_dataset.cameras[rows].to(self.device)
            pinhole = from_nerfstudio(cameras)
            images = self.datamanager.image_cache.get(chosen).to(self.device)
            theta = fit_theta(
                self.model.avatar,
                self.model.driving_theta(chosen),
                pinhole,
                images,
                model.refine_held_out,
                config=model.refinement,
                reference=self.model.frame_theta[list(tracked.train)],
                backend=model.rasterizer,
            )
            drawn = self.model.avatar.render(theta, pinhole, backend=model.rasterizer).image
            for image, target in zip(drawn, images):
                found = evaluate_images(image[None], target[None], self.model.lpips_metric)
                numbers = {n: value for n, value in found.items() if isinstance(value, float)}
                scores.append({f"{name}_refined": value for name, value in numbers.items()})
        return with_sharpness(mean_scores(scores), "_refined")


def to_look_at(config: RGBAvatarPipelineConfig, device: str) -> tuple[RGBAvatarPipelineConfig, str]:
    """The run's config and a device as they can draw on this machine, wherever it was trained.

    nerfstudio takes a GPU wherever there is one; without kernels for it the processor is quicker.
    """
    available = available_backends()
    if torch.device(device).type == "cuda" and "cuda" not in available and "cpu" in available:
        device = "cpu"
    if config.model.rasterizer not in ("auto", "reference", torch.device(device).type):
        config = replace(config, model=replace(config.model, rasterizer="auto"))
    return config, device


def _as_batch(cameras: Cameras, batch: dict[str, Any]) -> TrainingBatch:
    """What the datamanager serves, as a step takes it."""
    metadata = cameras.metadata or {}
    return TrainingBatch(
        metadata["theta"],
        from_nerfstudio(cameras),
        batch["image"],
        metadata["background"],
        metadata["position"][:, 0].long(),
    )
