"""nerfstudio's model around an `Avatar`; everything that is the method happens there."""

# pyright: reportIncompatibleVariableOverride=false
# nerfstudio's classes are used by narrowing their fields, which a strict type system forbids.

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import (
    TrainingCallback,
    TrainingCallbackAttributes,
    TrainingCallbackLocation,
)
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor
from torch.nn import Parameter

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.metrics import LPIPSMetric, evaluate_images
from rgbavatar_ns.avatar.refinement.corrections import RefinementConfig
from rgbavatar_ns.avatar.training.color_init import ColorInitSchedule
from rgbavatar_ns.avatar.training.fused_step import FusedStep
from rgbavatar_ns.avatar.training.loop import TrainingBatch
from rgbavatar_ns.avatar.training.losses import (
    LPIPSLoss,
    composite,
    l1_loss,
    rgba_to_float,
)
from rgbavatar_ns.avatar.training.optimizer_states import unsupported_reason
from rgbavatar_ns.avatar.training.orthogonality import orthogonality_loss, orthogonalize
from rgbavatar_ns.avatar.training.recorded_step import RecordedStep
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.kernels import PinholeCameras, RenderedBatch
from rgbavatar_ns.plugin.cameras import filled_depth, from_nerfstudio
from rgbavatar_ns.plugin.dataparser import Subject
from rgbavatar_ns.plugin.training.checkpoint_state import model_state, require_same_layout
from rgbavatar_ns.plugin.training.refinement import FrameRefinement, require_same_refinement

Outputs = dict[str, Tensor]

_ORTHOGONALITY_WEIGHT, _ORTHOGONALIZE_EVERY = 10.0, 1000


@dataclass
class RGBAvatarModelConfig(ModelConfig):
    """The avatar and how it is trained."""

    _target: type = field(default_factory=lambda: RGBAvatarModel)
    avatar: AvatarConfig = field(default_factory=AvatarConfig)
    """Sizes, variants and initial values of the avatar."""
    initialize_colors: bool = True
    """Give each Gaussian the mean colour of the pixels it covers when it is first seen."""
    lpips_weight: float = 0.0
    """Weight of the LPIPS loss (paper: 0, and 0.05 for its sharper variant)."""
    lpips_start_step: int = 0
    """Step from which the LPIPS loss counts."""
    lpips_metric: bool = True
    """Whether `ns-eval` computes LPIPS; its network is downloaded once (528 MB)."""
    orthogonality: Literal["free", "loss", "qr", "gram_schmidt"] = "free"
    """Keep the bases orthogonal, by a loss of weight 10 or every 1,000 steps by QR decomposition or
    Gram-Schmidt (paper, supplement, where none of them helps)."""
    refine_tracking: bool = False
    """Correct each training frame's tracked pose, expression and translation a little, together
    with the avatar. Held-out frames take what a linear map learns from these corrections; their
    images are not looked at."""
    refine_held_out: int = 0
    """Steps of fitting held-out frames to their images with the avatar frozen; `ns-eval` then
    reports psnr_refined and others beside the plain ones. 0 leaves it out."""
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    """How far and how quickly tracking is corrected."""
    rasterizer: str = "auto"
    """Backend of the rasterizer, one of `rgbavatar_ns.kernels.available_backends()` or auto."""
    fast: bool = True
    """Take training steps without autograd where that can be done, several times faster. It needs
    the method's own loss (no LPIPS) and optimizers (plain Adam, no max_norm) and the compiled
    rasterizer. False keeps to the readable path. Both give the same up to rounding, and a run can
    be resumed with the other."""
    batch_parallel: bool = True
    """Draw the images of a training batch together. False draws one after another and sums their
    gradients (the paper's "naive batch", to measure against), without `fast`."""
    seed: int | None = None
    """Seed of the weight network's initial values; by default that of the run, `--machine.seed`."""
    enable_collider: bool = False
    """Part of nerfstudio's ray-based models; not used."""


class RGBAvatarModel(Model):
    """Draws the avatar for nerfstudio's cameras, which carry theta as metadata.

    A camera without theta (the viewer's, a camera path's) shows what the pipeline's viewer panel
    has chosen.
    """

    config: RGBAvatarModelConfig
    frame_theta: Tensor
    view: Callable[[PinholeCameras, float | None], Outputs] | None = None
    """Draws a camera that brings no theta, at a time in [0, 1]; set by the pipeline."""

    def populate_modules(self) -> None:
        """Build the avatar of the dataset's subject."""
        super().populate_modules()
        subject = self.kwargs["metadata"]["subject"]
        assert isinstance(subject, Subject)
        self.subject = subject
        seed = 0 if self.config.seed is None else self.config.seed
        self.avatar = Avatar(
            HeadModel(subject.arrays), subject.identity, self.config.avatar, seed=seed
        )
        self.register_buffer("frame_theta", subject.theta, persistent=False)
        self.refinement = None
        if self.config.refine_tracking:
            self.refinement = FrameRefinement(subject, self.config.refinement)
        self.color_schedule = ColorInitSchedule()
        self.lpips_loss = LPIPSLoss()
        self.lpips_metric: LPIPSMetric | None = None

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """The avatar's parameters under the names of the paper's learning rates."""
        return self.avatar.parameter_groups()

    def get_outputs(self, ray_bundle: RayBundle | Cameras) -> dict[str, Tensor | list[Any]]:
        """Draw B cameras that bring theta: rgb [B H W 3], accumulation and depth [B H W 1].

        The background is what the cameras' metadata brings, else black. Depth is in metres along
        the camera's z, and only computed outside training.
        """
        if not isinstance(ray_bundle, Cameras):
            raise UserError(
                "This method draws whole images and cannot render single rays.",
                "Leave out options that trace rays, such as --render-nearest-camera.",
            )
        return {**self._draw(ray_bundle)}

    def _draw(self, cameras: Cameras) -> Outputs:
        cameras = cameras if cameras.shape else cameras.reshape((1,))
        background = (cameras.metadata or {}).get("background")
        drawn = self._rendered(self._frames_theta(cameras), from_nerfstudio(cameras), background)
        outputs = {"rgb": drawn.image, "accumulation": drawn.alpha}
        if drawn.depth is not None:
            outputs["depth"] = filled_depth(drawn.depth, drawn.alpha)
        if self.training:
            self._cameras = cameras
        return outputs

    def _rendered(
        self, theta: Tensor, cameras: PinholeCameras, background: Tensor | None
    ) -> RenderedBatch:
        """The batch together, or in training without `batch_parallel` one image after another."""
        draw = partial(
            self.avatar.render, backend=self.config.rasterizer, with_depth=not self.training
        )
        if self.config.batch_parallel or not self.training:
            return draw(theta, cameras, background)
        backgrounds = [None] * len(theta) if background is None else background.split(1)
        drawn = [
            draw(one, cameras.select([k]), behind)
            for k, (one, behind) in enumerate(zip(theta.split(1), backgrounds))
        ]
        return RenderedBatch(
            torch.cat([one.image for one in drawn]), torch.cat([one.alpha for one in drawn])
        )

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: Any = None) -> Outputs:
        """Draw one camera: [H W C] images. nerfstudio's crop box does not apply and is ignored.

        A camera without theta shows what `view` chooses.
        """
        camera = camera.to(self.device)
        if (camera.metadata or {}).get("theta") is None:
            assert self.view is not None, "only a pipeline's model draws cameras without theta"
            time = None if camera.times is None else float(camera.times.reshape(-1)[0])
            return self.view(from_nerfstudio(camera), time)
        return {name: image[0] for name, image in self._draw(camera).items()}

    def get_loss_dict(
        self,
        outputs: Outputs,
        batch: dict[str, Any],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """L1 of both images over the batch's backgrounds, and LPIPS if it is on."""
        image = outputs["rgb"]
        target = composite(rgba_to_float(batch["image"]), batch["background"])
        losses = {"l1": l1_loss(image, target)}
        if self._lpips_counts(batch["step"]):
            losses["lpips"] = self.config.lpips_weight * self.lpips_loss(image, target)
        if self._orthogonality() == "loss":
            error = orthogonality_loss(self.avatar.blendshapes)
            losses["orthogonality"] = _ORTHOGONALITY_WEIGHT * error
        self._images_rgba = batch["image"]
        self._shown = self._shown_batch
        return losses

    def can_fuse(self, step: int, optimizers: Iterable[torch.optim.Optimizer]) -> bool:
        """Say whether `fused_losses` may be asked for this step."""
        own_loss = not self._lpips_counts(step) and self._orthogonality() != "loss"
        wanted = self.config.fast and self.config.batch_parallel and own_loss
        return wanted and unsupported_reason(self.avatar, optimizers) is None

    def fused_losses(
        self,
        cameras: Cameras,
        batch: dict[str, Any],
        optimizers: Iterable[torch.optim.Optimizer],
    ) -> dict[str, Tensor] | None:
        """Take the optimizers' step on a batch without autograd and return its losses.

        None, and no step, where the rasterizer's backend cannot. As drawing the batch,
        `get_loss_dict`, its gradients and the optimizers' steps, up to rounding.
        """
        loss = FusedStep(self.avatar, optimizers)(
            self._frames_theta(cameras),
            from_nerfstudio(cameras),
            batch["image"],
            batch["background"],
            backend=self.config.rasterizer,
        )
        self._cameras, self._images_rgba = cameras, batch["image"]
        self._shown = self._shown_batch
        return None if loss is None else {"l1": loss}

    def graphed_losses(
        self, graphed: RecordedStep, rows: list[int], background: Tensor
    ) -> dict[str, Tensor]:
        """Take a step on the training frames `rows` and return its losses."""
        loss, frames = graphed(rows, background), graphed.frames
        self._shown = lambda: TrainingBatch(
            frames.theta[rows], frames.cameras.select(rows), frames.images_rgba[rows]
        )
        return {"l1": loss}

    def _shown_batch(self) -> TrainingBatch:
        """What a step through nerfstudio's cameras has shown."""
        cameras = from_nerfstudio(self._cameras)
        return TrainingBatch(self._theta.detach(), cameras, self._images_rgba)

    def driving_theta(self, positions: list[int]) -> Tensor:
        """What drives the avatar in these frames: [F H], tracked, and corrected or calibrated."""
        theta = self.frame_theta[positions]
        if self.refinement is None:
            return theta
        return self.refinement.corrected(theta, theta.new_tensor(positions)[:, None])

    def _frames_theta(self, cameras: Cameras) -> Tensor:
        """What the cameras bring, corrected where it belongs to a training frame.

        In training it is kept, and takes the loss's gradient if it is to be corrected further.
        """
        metadata = cameras.metadata or {}
        theta = metadata["theta"]
        if self.refinement is not None:
            theta = self.refinement.corrected(theta, metadata["position"])
        if self.training:
            theta.requires_grad_(self.refinement is not None)
            self._theta = theta
        return theta

    def orthogonalize(self, step: int) -> None:
        """Make the bases orthogonal after every 1,000th step."""
        method = self.config.orthogonality
        if (step + 1) % _ORTHOGONALIZE_EVERY == 0 and method in ("qr", "gram_schmidt"):
            orthogonalize(self.avatar.blendshapes, method)

    def _orthogonality(self) -> str:
        return self.config.orthogonality if self.config.avatar.num_bases > 0 else "free"

    def _lpips_counts(self, step: int) -> bool:
        return self.config.lpips_weight > 0 and step >= self.config.lpips_start_step

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """After the optimiser's step: corrected tracking, orthogonal bases, colours."""
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        wanted = []
        if self.refinement is not None:
            wanted.append(self.refine_tracking)
        if self._orthogonality() in ("qr", "gram_schmidt"):
            wanted.append(self.orthogonalize)
        if self.config.initialize_colors:
            wanted.append(self.initialize_colors)
        return [TrainingCallback(where_to_run=after, func=function) for function in wanted]

    def refine_tracking(self, step: int) -> None:
        """Correct the theta of the frames of `step` by the gradient that it has left there."""
        gradient = self._theta.grad
        if self.refinement is not None and gradient is not None:
            position = (self._cameras.metadata or {})["position"]
            self.refinement.step(step, position, gradient)

    def initialize_colors(self, step: int) -> None:
        """Initialise the colours of Gaussians that the batch of `step` shows for the first time."""
        if not self.color_schedule.due(step) or bool(self.avatar.color_initialized.all()):
            return
        shown = self._shown()
        self.avatar.initialize_colors(
            shown.theta, shown.cameras, shown.images_rgba, backend=self.config.rasterizer
        )

    def get_image_metrics_and_images(
        self, outputs: Outputs, batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM and, if it is there, LPIPS of one image; truth, avatar, error x 4 in a row."""
        image = outputs["rgb"][None]
        truth = batch["image"].to(self.device)[None]
        rgba = batch["image_rgba"].to(self.device)[None]
        scores = evaluate_images(image, rgba, self.lpips_metric)
        metrics = {name: value for name, value in scores.items() if isinstance(value, float)}
        error = ((image - truth).abs() * 4).clamp(0, 1)
        row = torch.cat([truth, image.clamp(0, 1), error], dim=2)[0]
        return metrics, {"truth_avatar_error": row}

    def get_rgba_image(self, outputs: Outputs, output_name: str = "rgb") -> Tensor:
        """Straight-alpha RGBA [H W 4] of an image over black."""
        alpha = outputs["accumulation"]
        return torch.cat([(outputs[output_name] / alpha.clamp(min=1e-6)).clamp(0, 1), alpha], -1)

    def get_extra_state(self) -> dict[str, Any]:
        """What rebuilds the avatar without this dataset: its make, and every frame's theta."""
        subject = self.subject
        if self.refinement is not None:
            subject = replace(subject, theta=self.refinement.all_frames(subject.theta))
        return model_state(self.avatar, subject)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Nothing to restore: `load_state_dict` has compared it with this dataset's subject."""

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load parameters; raises UserError if theta's layout or the refinement is another one."""
        require_same_layout(state_dict, self.avatar)
        require_same_refinement(state_dict, self.refinement)
        return super().load_state_dict(state_dict, strict=strict, assign=assign)
