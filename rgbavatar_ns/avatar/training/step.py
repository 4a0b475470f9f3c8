"""One optimiser step on a batch of frames, and what follows it.

There are three ways to take it, with the same numbers up to rounding: recorded (one CUDA graph,
frames on the device), fused (the backend's own loops, without autograd) and eager (torch).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import LEARNING_RATES, Avatar
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.avatar.prior import SurfacePrior, VirtualViews
from rgbavatar_ns.avatar.refinement.frames import FrameRefinement
from rgbavatar_ns.avatar.training.batches import (
    ChosenFrames,
    DeviceFrames,
    TrainingBatch,
    each_its_own,
)
from rgbavatar_ns.avatar.training.color_init import FirstColors, FirstColorsKind
from rgbavatar_ns.avatar.training.cuda_graph import Recorder, record_cuda_graph
from rgbavatar_ns.avatar.training.fused_step import FusedStep, probed_renderer
from rgbavatar_ns.avatar.training.losses import image_losses, random_backgrounds
from rgbavatar_ns.avatar.training.optimizer_states import take_steps, unsupported_reason
from rgbavatar_ns.avatar.training.orthogonality import (
    ORTHOGONALITY_WEIGHT,
    ORTHOGONALIZE_EVERY,
    orthogonality_loss,
    orthogonalize,
)
from rgbavatar_ns.avatar.training.recorded_step import RecordedStep
from rgbavatar_ns.drawing.compositing import ImagesRGBA
from rgbavatar_ns.kernels import DeviceRenderer, MorphedRenderer

Losses = dict[str, Float[Tensor, ""]]
StepKind = Literal["recorded", "fused", "eager"]
Orthogonality = Literal["free", "loss", "qr", "gram_schmidt"]


@dataclass(frozen=True)
class TrainingOptions:
    """What the paper leaves to choose about training."""

    seed: int = 0
    """Seed of the random backgrounds."""
    lpips_weight: float = 0.0
    """Weight of the LPIPS loss (paper's variant: .05); 0 needs no LPIPS network."""
    lpips_start_step: int = 0
    """First step with the LPIPS loss (release: after 20k images)."""
    first_colors: FirstColorsKind | None = "matted"
    """How Gaussians are given their first colours; None leaves them grey."""
    surface_prior: bool = True
    """Keep what the film does not show on the person's surface, closed, and plain but for hair
    (ours; the paper leaves it to chance)."""
    orthogonality: Orthogonality = "free"
    """How bases are kept orthogonal: not at all, by a loss, or by QR or Gram-Schmidt at times."""
    max_norm: Mapping[str, float] = field(default_factory=dict)
    """Largest norm of a parameter group's gradient, by its name; others are not clipped."""
    fast: bool = True
    """Do without autograd where that can be; False keeps to the readable way."""
    batch_parallel: bool = True
    """Draw a batch together; False draws image by image (the paper's "naive batch"), eagerly."""
    backend: str = "auto"
    """Backend of the rasterizer."""

    def lpips_counts(self, step: int) -> bool:
        """Whether the loss of `step` has an LPIPS part."""
        return self.lpips_weight > 0 and step >= self.lpips_start_step


def make_optimizer(
    avatar: Avatar, learning_rates: dict[str, float] | None = None
) -> torch.optim.Adam:
    """Return Adam over the avatar's parameter groups, with the paper's learning rates.

    Epsilon 1e-15 as the release and 3DGS: gradients of single Gaussians are far below Adam's
    default of 1e-8. Fused: four times faster on a CPU.
    """
    rates = LEARNING_RATES | (learning_rates or {})
    groups = [
        {"name": name, "params": parameters, "lr": rates[name]}
        for name, parameters in avatar.parameter_groups().items()
    ]
    return torch.optim.Adam(groups, eps=1e-15, fused=True)


class TrainingStep:
    """Trains an avatar in place, a batch a call; built once a run, which chooses the way.

    Args:
        avatar: what is trained.
        optimizers: those that hold its parameters; by default `make_optimizer`'s.
        options: losses, colours, and which ways may be taken.
        frames: gives all training frames on the device, or None; asked only where steps could be
            recorded. A recorded step takes `ChosenFrames` of them in place of a `TrainingBatch`.
        refinement: corrects the frames' theta by the gradient that each step leaves there.
        prior: what was seen in a run's earlier steps; where options ask for it, by default a fresh
            one, which does nothing in a run that it has not seen from its first step.
        lpips: the LPIPS loss, where it counts.
        recorder: how a step becomes one that the device takes by itself.

    Attributes:
        kind: the way that is taken: "recorded", "fused" or "eager".
        reason: why it is this one, as the rest of a sentence.
    """

    def __init__(
        self,
        avatar: Avatar,
        optimizers: torch.optim.Optimizer | Iterable[torch.optim.Optimizer] | None = None,
        options: TrainingOptions | None = None,
        *,
        frames: Callable[[], DeviceFrames | None] | None = None,
        refinement: FrameRefinement | None = None,
        prior: SurfacePrior | None = None,
        lpips: LPIPSLoss | None = None,
        recorder: Recorder = record_cuda_graph,
    ) -> None:
        if optimizers is None or isinstance(optimizers, torch.optim.Optimizer):
            optimizers = [make_optimizer(avatar) if optimizers is None else optimizers]
        self.avatar, self.optimizers = avatar, list(optimizers)
        self.options = TrainingOptions() if options is None else options
        self.refinement = refinement
        self._prior = prior if self.options.surface_prior else None
        if self.options.surface_prior and prior is None:
            self._prior = SurfacePrior(avatar).to(avatar.identity.device)
        self._lpips = LPIPSLoss() if lpips is None else lpips
        kind = self.options.first_colors
        self._first_colors = FirstColors(avatar, kind) if kind is not None else None
        self._orthogonality = self.options.orthogonality if avatar.config.num_bases else "free"
        self._fused: FusedStep | None = None
        self._frames: DeviceFrames | None = None
        self._shown: DeviceFrames | None = None
        self._recorded: RecordedStep | None = None
        self._recorder = recorder
        self.kind: StepKind = "eager"
        renderer = probed_renderer(avatar, self.options.backend) if self.options.fast else None
        autograd = self._autograd_reason(renderer)
        if autograd is not None:
            self.reason = autograd
            return
        self.kind, self._fused = "fused", FusedStep(avatar, self.optimizers, self.options.backend)
        host = self._host_reason(renderer)
        if host is None and frames is not None:
            self._frames = frames()
        if self._frames is not None:
            self.kind, self.reason = "recorded", "all frames lie on the device"
        else:
            self.reason = host or "not all frames lie on the device"

    def _autograd_reason(self, renderer: MorphedRenderer | None) -> str | None:
        """Why steps go through autograd; None where they need not."""
        options = self.options
        if not options.fast:
            return "the fast ways are switched off"
        if not options.batch_parallel:
            return "images are drawn one by one"
        if self._orthogonality == "loss":
            return "the loss of orthogonal bases goes through autograd"
        if options.max_norm:
            return "gradients are clipped"
        if options.lpips_counts(0):
            return "the LPIPS loss goes through autograd"
        if renderer is None:
            return "the rasterizer's backend has no other way for this avatar"
        return unsupported_reason(self.avatar, self.optimizers)

    def _host_reason(self, renderer: MorphedRenderer | None) -> str | None:
        """Why a step needs the host; None where the device can take it alone."""
        if self.options.lpips_weight > 0:
            return f"the LPIPS loss takes over, eagerly, at step {self.options.lpips_start_step}"
        if not isinstance(renderer, DeviceRenderer):
            return "the rasterizer's backend needs the host"
        return "tracking is refined" if self.refinement is not None else None

    def __call__(self, batch: TrainingBatch | ChosenFrames, step: int) -> Losses:
        """Take step `step` and what is due after it; returns the parts of the loss, detached.

        Raises ValueError for `ChosenFrames` where steps are not recorded, or images that do not
        fit; UserError where an LPIPS loss is asked for but unavailable.
        """
        if isinstance(batch, ChosenFrames):
            return self._take_recorded(batch, step)
        self._begin(step, lambda: batch)
        theta = batch.theta
        if self.refinement is not None:
            theta = self.refinement.begin(theta, batch.position)
        self.avatar.widen_film_range(theta)
        filmed = replace(batch, theta=theta)
        shown, view = self._with_view(filmed, step)
        count = len(theta) if view is None else len(theta) - 1
        losses = self._losses(shown, step, count, partial(self._images, filmed, step, view))
        if self.refinement is not None and batch.position is not None:
            self.refinement.learn(step, theta, batch.position[:count])
        self._finish(step)
        return losses

    def look_back(self, frames: Iterable[TrainingBatch]) -> bool:
        """Give first colours to what these frames show of the avatar as it is after a last step.

        What a step's update brings to light is found when its frame is drawn again; after the last
        step none is. Returns whether the avatar changed.
        """
        known = self.avatar.color_initialized
        before = int(known.sum())
        if self._first_colors is None or before == len(known):
            return False
        for number, batch in enumerate(frames):
            if self.refinement is not None and batch.position is not None:
                theta = self.refinement.corrected(batch.theta, batch.position).detach()
                batch = replace(batch, theta=theta)
            count, background = len(batch.theta), batch.background
            if background is None:
                background = random_backgrounds(number, count, self.options.seed)
            seen = self._seen_first(batch, background.to(batch.theta), count)
            if seen is not None:
                self._first_colors.give(seen)
        return int(known.sum()) > before

    def _take_recorded(self, chosen: ChosenFrames, step: int) -> Losses:
        frames, rows = self._frames, chosen.rows
        if frames is None:
            raise ValueError(f"Steps are {self.kind}: {self.reason}. Pass a TrainingBatch.")
        self._begin(step, lambda: frames.batch(rows))
        views = self._views()
        if self._recorded is None:
            self.avatar.widen_film_range(frames.theta)
            self._shown = frames
            if views is not None:
                bank = views.frames(self.avatar, range(len(views.theta)))
                others = DeviceFrames(bank.theta, bank.cameras, bank.images_rgba)
                if bank.images_rgba.shape[1:] == frames.images_rgba.shape[1:]:
                    self._shown = frames.joined(others)
            self._recorded = RecordedStep(
                self.avatar,
                self.optimizers,
                self._shown,
                len(rows),
                backend=self.options.backend,
                first_colors=self._first_colors,
                num_filmed=len(frames.theta),
                recorder=self._recorder,
            )
        if self._prior is not None and self._prior.due(step):
            self._look(frames.batch(rows))
        # Of a run on images of another size the views are of no use.
        used = views is not None and self._shown is not frames
        taken, view = rows, views.due(step, len(rows)) if views is not None and used else None
        if views is not None and view is not None:
            assert self._shown is not None
            row = len(frames.theta) + view
            renderer = self._recorded.renderer_of(row)
            views.redraw(self.avatar, view, renderer, self._shown.images_rgba[row])
            taken = [*rows[:-1], row]
        losses = {"l1": self._recorded(taken, chosen.background)}
        self._finish(step)
        return losses

    def _views(self) -> VirtualViews | None:
        """From where nobody filmed; None where no prior has measured the person."""
        return self._prior.views if self._prior is not None and self._prior.has_begun else None

    def _with_view(self, batch: TrainingBatch, step: int) -> tuple[TrainingBatch, int | None]:
        """The batch; at times its last frame gives way to a view that nobody filmed.

        Returns which one did; its image is not completed yet.
        """
        views, count = self._views(), len(batch.theta)
        index = views.due(step, count) if views is not None else None
        if views is None or index is None:
            return batch, None
        view = views.frames(self.avatar, [index])
        if view.images_rgba.shape[1:] != batch.images_rgba.shape[1:]:
            return batch, None
        cameras = each_its_own(batch.cameras, count).select(range(count - 1))
        shown = TrainingBatch(
            torch.cat([batch.theta[:-1], view.theta.to(batch.theta)]),
            cameras.joined(view.cameras),
            batch.images_rgba,
            batch.background,
        )
        return shown, index

    def _images(
        self,
        filmed: TrainingBatch,
        step: int,
        view: int | None,
        renderer: MorphedRenderer | None = None,
    ) -> ImagesRGBA:
        """The step's images, a view's as the avatar is now; the prior looks at them when it is due.

        `renderer`: what is about to be drawn.
        """
        images, views, backend = filmed.images_rgba, self._views(), self.options.backend
        if self._prior is not None and self._prior.due(step):
            self._look(filmed, renderer if view is None else None)
        if views is None or view is None:
            return images
        if renderer is None:
            last = views.frame(self.avatar, view, backend).images_rgba
        else:
            last = views.completed(self.avatar, view, renderer.draw_one(len(images) - 1))
        last = last if images.dtype == torch.uint8 else last.to(images) / 255
        return torch.cat([images[:-1], last.to(images.device)])

    def _look(self, filmed: TrainingBatch, renderer: MorphedRenderer | None = None) -> None:
        assert self._prior is not None
        frames = filmed.theta.detach(), filmed.cameras, filmed.images_rgba
        self._prior.look(self.avatar, *frames, renderer, self.options.backend)

    def _losses(
        self,
        batch: TrainingBatch,
        step: int,
        num_filmed: int,
        images_with: Callable[[MorphedRenderer | None], ImagesRGBA],
    ) -> Losses:
        """Step with the optimisers, and give first colours by the first `num_filmed` images.

        Theta's gradient is left where it requires one.
        """
        theta, background = batch.theta, batch.background
        if background is None:
            background = random_backgrounds(step, len(theta), self.options.seed)
        background = background.to(theta.device, self.avatar.blendshapes.position.dtype)
        images, by_autograd = batch.images_rgba, self.options.lpips_counts(step)
        # Compiled loops read 8-bit images; others have more to say.
        if self._fused is not None and images.dtype == torch.uint8 and not by_autograd:
            sight = self._first_colors.sight(num_filmed) if self._first_colors else None
            loss = self._fused(theta, batch.cameras, images, background, images_with, sight)
            if self._first_colors is not None and sight is not None:
                self._first_colors.give(sight)
            return {"l1": loss}
        batch = replace(batch, images_rgba=images_with(None))
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
        losses = self.eager_losses(batch, theta, background, step)
        torch.stack(list(losses.values())).sum().backward()
        seen = self._seen_first(batch, background, num_filmed)
        groups = self.avatar.parameter_groups()
        for name, norm in self.options.max_norm.items():
            torch.nn.utils.clip_grad_norm_(groups[name], norm)
        take_steps(self.optimizers)
        if self._first_colors is not None and seen is not None:
            self._first_colors.give(seen)
        return {name: loss.detach() for name, loss in losses.items()}

    def _seen_first(
        self, batch: TrainingBatch, background: Float[Tensor, "B 3"], num_filmed: int
    ) -> Float[Tensor, "N 5"] | None:
        """How the first images show what waits for its first colour; None where nothing does."""
        if num_filmed == 0 or self._first_colors is None:
            return None
        if self._first_colors.sight(num_filmed) is None:
            return None
        cameras = batch.cameras
        if len(cameras.focal_px) > num_filmed:
            cameras = cameras.select(range(num_filmed))
        return self._first_colors.seen_in(
            batch.theta.detach()[:num_filmed],
            cameras,
            batch.images_rgba[:num_filmed],
            background[:num_filmed],
            backend=self.options.backend,
        )

    def eager_losses(
        self,
        batch: TrainingBatch,
        theta: Float[Tensor, "B H"],
        background: Float[Tensor, "B 3"],
        step: int,
    ) -> Losses:
        """The parts of the loss with their graph (paper, sec. 3.2); changes nothing."""
        cameras = batch.cameras
        draw = partial(self.avatar.render, backend=self.options.backend, differentiable=True)
        if self.options.batch_parallel:
            image = draw(theta, cameras, background).image
        else:
            each = [cameras.select([k % len(cameras.focal_px)]) for k in range(len(theta))]
            one_by_one = map(draw, theta.split(1), each, background.split(1))
            image = torch.cat([drawn.image for drawn in one_by_one])
        losses = image_losses(
            image,
            batch.images_rgba,
            background,
            self._lpips if self.options.lpips_counts(step) else None,
            self.options.lpips_weight,
        )
        if self._orthogonality == "loss":
            error = orthogonality_loss(self.avatar.blendshapes)
            losses["orthogonality"] = ORTHOGONALITY_WEIGHT * error
        return losses

    def _begin(self, step: int, shown: Callable[[], TrainingBatch]) -> None:
        """What is due before the first step of a run."""
        if step == 0 and self._prior is not None and not self._prior.has_begun:
            batch = shown()
            self._prior.begin(self.avatar, batch.theta, batch.cameras, batch.images_rgba)

    def _finish(self, step: int) -> None:
        """What is due after a step: neighbours held, what is not seen, orthogonal bases."""
        if self._prior is not None:
            self._prior.hold(self.avatar)
            if self._prior.due(step):
                self._prior.pull(self.avatar, step)
        # Last, since what is not seen is drawn to the surface with its bases.
        method = self._orthogonality
        if (step + 1) % ORTHOGONALIZE_EVERY == 0 and method in ("qr", "gram_schmidt"):
            orthogonalize(self.avatar.blendshapes, method)
