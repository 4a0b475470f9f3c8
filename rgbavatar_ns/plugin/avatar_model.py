"""nerfstudio's model around an avatar of any method: it draws, scores, and keeps what it is."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor
from torch.nn import Parameter

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.metrics import LPIPSMetric, evaluate_images
from rgbavatar_ns.avatar.refinement import RefinementConfig
from rgbavatar_ns.avatar.training.batches import DeviceFrames
from rgbavatar_ns.avatar.training.cuda_graph import Recorder
from rgbavatar_ns.avatar.training.losses import image_losses
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.avatar.training.step import TrainingStep
from rgbavatar_ns.drawing.compositing import error_strip, straight_alpha
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.options import Counted, Seed
from rgbavatar_ns.plugin.cameras import filled_depth, from_nerfstudio
from rgbavatar_ns.plugin.checkpoint_state import (
    misfits_told,
    model_state,
    require_same_layout,
    tell_another_person,
)
from rgbavatar_ns.plugin.dataparser import FilmedSubject
from rgbavatar_ns.plugin.refinement import frame_refinement, require_same_refinement

Outputs = dict[str, Tensor]


@dataclass
class AvatarModelConfig(ModelConfig):
    """What all methods have beside their avatar."""

    lpips_metric: bool = True
    """Whether `ns-eval` computes LPIPS (paper, release: yes); its network is downloaded once (528
    MB)."""
    refine_tracking: bool = False
    """Ours: correct each training frame's tracked pose, expression and translation a little,
    together with the avatar. Held-out frames take what a linear map learns from these corrections;
    their images are not looked at."""
    refine_held_out: Counted = 0
    """Steps of fitting held-out frames to their images with the avatar frozen; `ns-eval` then
    reports psnr_refined and others beside the plain ones. 0 leaves it out."""
    refine_held_out_frames: Counted = 0
    """So many of them, evenly spread, where fitting all would take too long; 0 fits all."""
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    """How far and how quickly tracking is corrected."""
    rasterizer: str = "auto"
    """Backend of the rasterizer: auto, or one of `rgbavatar_ns.kernels.available_backends()`."""
    seed: Seed | None = None
    """Seed of what is random in a fresh avatar; by default that of the run, `--machine.seed`."""
    enable_collider: bool = False
    """Part of nerfstudio's ray-based models: refused."""
    collider_params: tyro.conf.Suppress[dict[str, float] | None] = None
    loss_coefficients: tyro.conf.Suppress[dict[str, float]] = field(default_factory=dict)
    eval_num_rays_per_chunk: tyro.conf.Suppress[int] = 4096


class AvatarModel(Model):
    """Draws an avatar for nerfstudio's cameras, which carry theta as metadata.

    A camera without theta (the viewer's, `ns-render`'s) shows what the pipeline's viewer panel has
    chosen, or the moment of the film that is the camera's (`FilmPath`).
    """

    config: AvatarModelConfig
    avatar: AvatarMethod
    frame_theta: Tensor
    view: Callable[[Cameras, bool], Outputs] | None = None
    """Draws a camera that brings no theta, and whether a crop box is asked for; set by the
    pipeline."""
    filmed: Callable[[], FilmedSubject] | None = None
    """The film so far, where it grows while the avatar is trained; set by the pipeline."""

    def populate_modules(self) -> None:
        """Build the avatar of the dataset's subject."""
        super().populate_modules()
        subject = self.kwargs["metadata"]["subject"]
        assert isinstance(subject, FilmedSubject)
        self.subject = subject
        seed = 0 if self.config.seed is None else self.config.seed
        self.avatar = self.make_avatar(HeadModel(subject.arrays), subject.identity, seed)
        self.register_buffer("frame_theta", subject.theta, persistent=False)
        self.refinement = None
        if self.config.refine_tracking:
            self.refinement = frame_refinement(subject, self.config.refinement)
        self.lpips_metric: LPIPSMetric | None = None
        self.scores: list[dict[str, float]] = []  # of each frame since they were last cleared

    @abstractmethod
    def make_avatar(self, head: HeadModel, identity: Tensor, seed: int) -> AvatarMethod:
        """A fresh avatar of the subject."""

    @abstractmethod
    def training_step(
        self,
        optimizers: Iterable[torch.optim.Optimizer],
        max_norm: Mapping[str, float],
        frames: Callable[[], DeviceFrames | None],
        recorder: Recorder,
    ) -> TrainingStep | MethodStep:
        """The step that trains the avatar, for a run; `max_norm`: see `TrainingOptions`."""

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """The avatar's parameters by the names of its learning rates."""
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
        """L1 of both images over the batch's backgrounds, for nerfstudio's own evaluation."""
        return image_losses(outputs["rgb"], batch["image"], outputs["background"])

    def finish(self) -> bool:
        """Do what is due when all steps are done; whether that changed the avatar."""
        return False

    def changed_at_end(self) -> dict[str, Tensor]:
        """Copies of what `finish`, or looking back, may change, by its name in the avatar."""
        return {}

    @property
    def looks_back(self) -> bool:
        """Whether a run that is complete looks at all its training frames once more."""
        return False

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
        self.scores.append(dict(metrics))
        row = torch.cat([*error_strip(rgba, image, image.new_zeros(3))], dim=2)[0]
        return metrics, {"truth_avatar_error": row}

    def get_rgba_image(self, outputs: Outputs, output_name: str = "rgb") -> Tensor:
        """Straight-alpha RGBA [H W 4] of an image over black."""
        alpha = outputs["accumulation"]
        return straight_alpha(outputs[output_name], alpha).clamp(0, 1)

    def get_extra_state(self) -> dict[str, Any]:
        """What rebuilds the avatar without this dataset: its make, and every frame's theta."""
        subject = self.subject if self.filmed is None else self.filmed()
        if self.refinement is not None:
            theta = self.refinement.all_frames(subject.theta.to(self.device))
            subject = replace(subject, theta=theta.cpu())
        return model_state(self.avatar, subject)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Nothing to restore: `load_state_dict` has compared its layout with this dataset's."""

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load parameters; raises UserError where they are not all those of this model's make."""
        require_same_layout(state_dict, self.avatar)
        require_same_refinement(state_dict, self.refinement)
        tell_another_person(state_dict, self.subject)
        self.avatar.fit_to(state_dict, "avatar.")
        state_dict = self.of_this_version(state_dict)
        with misfits_told():
            return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def of_this_version(self, state_dict: Mapping[str, Any]) -> dict[str, Any]:
        """Return a checkpoint's state with what an earlier version did not keep."""
        fresh = self.avatar.defaults_of_before()
        return {f"avatar.{name}": value for name, value in fresh.items()} | dict(state_dict)
