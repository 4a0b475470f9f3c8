"""nerfstudio's model around an `Avatar`; everything that is the method happens there."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor
from torch.nn import Parameter

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.metrics import LPIPSMetric, evaluate_images
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.refinement import RefinementConfig
from rgbavatar_ns.avatar.training.color_init import FirstColorsKind, hide_unseen
from rgbavatar_ns.avatar.training.losses import image_losses
from rgbavatar_ns.avatar.training.step import Orthogonality, TrainingOptions
from rgbavatar_ns.drawing.compositing import error_strip, straight_alpha
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.options import Counted, Seed, Weight
from rgbavatar_ns.plugin.cameras import filled_depth, from_nerfstudio
from rgbavatar_ns.plugin.checkpoint_state import (
    misfits_told,
    model_state,
    of_this_version,
    require_same_layout,
)
from rgbavatar_ns.plugin.dataparser import Subject
from rgbavatar_ns.plugin.refinement import frame_refinement, require_same_refinement

Outputs = dict[str, Tensor]


@dataclass
class RGBAvatarModelConfig(ModelConfig):
    """The avatar and how it is trained."""

    _target: type = field(default_factory=lambda: RGBAvatarModel)
    avatar: AvatarConfig = field(default_factory=AvatarConfig)
    """Sizes, variants and initial values of the avatar."""
    initialize_colors: bool = True
    """Give each Gaussian the mean colour of the pixels it covers when it is first seen (paper,
    release: yes)."""
    first_colors: FirstColorsKind = "matted"
    """How: paper, the mean of the training picture over its random background, in the first step in
    which its weight exceeds .1; matted (ours), the mean of the person alone. (The release: .01.)"""
    surface_prior: bool = True
    """Keep what the film does not show on the person's surface, closed and plain: heads can be
    turned beyond their film. Ours; False leaves it to chance, as the paper does."""
    hide_unseen: bool = False
    """At the end of a run make the Gaussians transparent that no training frame showed (release;
    the paper is silent). Off in ours, where the surface prior looks after them."""
    lpips_weight: Weight = 0.0
    """Weight of the LPIPS loss (paper: 0, and 0.05 for its sharper variant)."""
    lpips_start_step: Counted = 0
    """Step from which the LPIPS loss counts (paper: named without a start; release: 2000)."""
    lpips_metric: bool = True
    """Whether `ns-eval` computes LPIPS (paper, release: yes); its network is downloaded once (528
    MB)."""
    orthogonality: Orthogonality = "free"
    """Leave the bases as they are (paper, release: free), or keep them orthogonal, by a loss of
    weight 10 or every 1,000 steps by QR decomposition or Gram-Schmidt (paper, supplement: none
    helps)."""
    refine_tracking: bool = False
    """Ours: correct each training frame's tracked pose, expression and translation a little,
    together with the avatar. Held-out frames take what a linear map learns from these corrections;
    their images are not looked at."""
    refine_held_out: Counted = 0
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
    seed: Seed | None = None
    """Seed of the weight network's initial values; by default that of the run, `--machine.seed`."""
    enable_collider: bool = False
    """Part of nerfstudio's ray-based models: refused."""
    collider_params: tyro.conf.Suppress[dict[str, float] | None] = None
    loss_coefficients: tyro.conf.Suppress[dict[str, float]] = field(default_factory=dict)
    eval_num_rays_per_chunk: tyro.conf.Suppress[int] = 4096


class RGBAvatarModel(Model):
    """Draws the avatar for nerfstudio's cameras, which carry theta as metadata.

    A camera without theta (the viewer's, `ns-render`'s) shows what the pipeline's viewer panel has
    chosen, or the moment of the film that is the camera's (`FilmPath`).
    """

    config: RGBAvatarModelConfig
    frame_theta: Tensor
    view: Callable[[Cameras, bool], Outputs] | None = None
    """Draws a camera that brings no theta, and whether a crop box is asked for; set by the
    pipeline."""

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
        if self.config.hide_unseen and not self.config.initialize_colors:
            raise UserError(
                "What was never seen is known by its missing first colour, and these are off.",
                "Leave out --pipeline.model.hide-unseen or --pipeline.model.initialize-colors.",
            )
        self.register_buffer("frame_theta", subject.theta, persistent=False)
        self.refinement = None
        if self.config.refine_tracking:
            self.refinement = frame_refinement(subject, self.config.refinement)
        self.prior = None
        if self.config.surface_prior:
            self.prior = SurfacePrior(self.avatar)
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
                "Leave out options that trace rays, such as --render-nearest-camera; in place of "
                "ns-export take `rgbavatar export RUN DST --format ply` (or another).",
            )
        return {**self._draw(ray_bundle)}

    def _draw(self, cameras: Cameras) -> Outputs:
        cameras = cameras if cameras.shape else cameras.reshape((1,))
        metadata = cameras.metadata or {}
        theta = metadata["theta"]
        if self.refinement is not None:
            theta = self.refinement.corrected(theta, metadata["position"][:, 0].long())
        background = metadata.get("background")
        drawn = self.avatar.render(
            theta,
            from_nerfstudio(cameras),
            background,
            backend=self.config.rasterizer,
            with_depth=not self.training,
            differentiable=self.training,
        )
        outputs = {"rgb": drawn.image, "accumulation": drawn.alpha}
        if drawn.depth is not None:
            outputs["depth"] = filled_depth(drawn.depth, drawn.alpha)
        if background is not None:
            outputs["background"] = background
        return outputs

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: Any = None) -> Outputs:
        """Draw one camera: [H W C] images. nerfstudio's crop box does not apply.

        A camera without theta shows what `view` chooses.
        """
        camera = camera.to(self.device)
        if (camera.metadata or {}).get("theta") is None:
            assert self.view is not None, "only a pipeline's model draws cameras without theta"
            return self.view(camera, obb_box is not None)
        return {name: image[0] for name, image in self._draw(camera).items()}

    def get_loss_dict(
        self,
        outputs: Outputs,
        batch: dict[str, Any],
        metrics_dict: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """L1 of both images over the batch's backgrounds, and LPIPS if it is on.

        The part that depends on the image: `TrainingStep` adds what bases and tracking ask for.
        """
        counts = self.training_options().lpips_counts(batch["step"])
        lpips = self.lpips_loss if counts else None
        return image_losses(
            outputs["rgb"], batch["image"], outputs["background"], lpips, self.config.lpips_weight
        )

    def training_options(self) -> TrainingOptions:
        """What the config says of training, as `TrainingStep` takes it."""
        config = self.config
        return TrainingOptions(
            lpips_weight=config.lpips_weight,
            lpips_start_step=config.lpips_start_step,
            first_colors=config.first_colors if config.initialize_colors else None,
            surface_prior=config.surface_prior,
            orthogonality=config.orthogonality,
            fast=config.fast,
            batch_parallel=config.batch_parallel,
            backend=config.rasterizer,
        )

    def finish(self) -> bool:
        """Do what is due when all steps are done; whether that changed the avatar."""
        if self.config.hide_unseen:
            hide_unseen(self.avatar)
        return self.config.hide_unseen

    def driving_theta(self, positions: list[int]) -> Tensor:
        """What drives the avatar in these frames: [F H], tracked, and corrected or calibrated."""
        theta = self.frame_theta[positions]
        if self.refinement is None:
            return theta
        return self.refinement.corrected(theta, torch.tensor(positions, device=theta.device))

    def get_image_metrics_and_images(
        self, outputs: Outputs, batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM and, if it is there, LPIPS of one image; truth, avatar, error x 4 in a row."""
        image = outputs["rgb"][None]
        rgba = batch["image_rgba"].to(self.device)[None]
        scores = evaluate_images(image, rgba, self.lpips_metric)
        metrics = {name: value for name, value in scores.items() if isinstance(value, float)}
        row = torch.cat([*error_strip(rgba, image, image.new_zeros(3))], dim=2)[0]
        return metrics, {"truth_avatar_error": row}

    def get_rgba_image(self, outputs: Outputs, output_name: str = "rgb") -> Tensor:
        """Straight-alpha RGBA [H W 4] of an image over black."""
        alpha = outputs["accumulation"]
        return straight_alpha(outputs[output_name], alpha).clamp(0, 1)

    def get_extra_state(self) -> dict[str, Any]:
        """What rebuilds the avatar without this dataset: its make, and every frame's theta."""
        subject = self.subject
        if self.refinement is not None:
            theta = self.refinement.all_frames(subject.theta.to(self.device))
            subject = replace(subject, theta=theta.cpu())
        return model_state(self.avatar, subject)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Nothing to restore: `load_state_dict` has compared it with this dataset's subject."""

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load parameters; raises UserError where they are not all those of this model's make."""
        require_same_layout(state_dict, self.avatar)
        require_same_refinement(state_dict, self.refinement)
        state_dict = of_this_version(state_dict, self.avatar, self.prior)
        with misfits_told():
            return super().load_state_dict(state_dict, strict=strict, assign=assign)
