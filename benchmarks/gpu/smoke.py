"""Whether anything works: the kernels, a picture, a training step and its recording."""

import copy
import time
from collections.abc import Mapping

import torch
from torch import Tensor

from benchmarks.gpu.rows import Figures, Rows, check
from benchmarks.gpu.workload import BARE, Training, Workload
from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.training import TrainingOptions, TrainingStep, make_optimizer
from rgbavatar_ns.avatar.training.batches import ChosenFrames, TrainingBatch
from rgbavatar_ns.bench.scenes import leaf_gaussians
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras, rasterize

MOST_OF_A_PIXEL = 2 / 255
"""A Gaussian that one of two roundings leaves out is below 1/255."""
MOST_OF_A_GRADIENT = 1e-2
"""Of its length, by the same."""
MOST_OF_A_LOSS = 1e-3
"""Two ways to step round differently, which Adam amplifies step by step."""
STEPS = 6
_READABLE = TrainingOptions(first_colors=None, surface_prior=False, fast=False, backend="reference")


def smoke(rows: Rows) -> None:
    """A row for each, every one with its time."""
    whole = Workload.here()
    work = whole.small()
    with rows.row("compile") as figures:
        start = time.perf_counter()
        work.launcher()
        figures["seconds"] = time.perf_counter() - start
    with rows.row("picture") as figures:
        figures |= picture(work)
    with rows.row("step") as figures:
        figures |= step(work)
    with rows.row("replay") as figures:
        figures |= replay(work)
    with rows.row("crowded_picture") as figures:
        figures |= picture(whole.crowded())


def picture(work: Workload) -> Figures:
    """A batch of pictures with gradients, against the reference in float64."""
    gaussians, cameras = work.scene()
    doubled = GaussianSet(**{n: value.double().cpu() for n, value in vars(gaussians).items()})
    start = time.perf_counter()
    image, gradients = _drawn(gaussians, cameras, "cuda")
    work.wait()
    seconds = time.perf_counter() - start
    expected_image, expected = _drawn(doubled, cameras.to(doubled.means), "reference")
    apart = (image.double().cpu() - expected_image).abs()
    figures: Figures = {
        "seconds": seconds,
        "largest_difference": float(apart.max()),
        "mean_difference": float(apart.mean()),
        "gradients": _relative_differences(gradients, expected),
    }
    check(figures, float(apart.max()) <= MOST_OF_A_PIXEL, "the picture differs from the reference")
    _check_gradients(figures)
    return figures


def _drawn(
    gaussians: GaussianSet, cameras: PinholeCameras, backend: str
) -> tuple[Tensor, dict[str, Tensor]]:
    leaves = leaf_gaussians(gaussians)
    image = rasterize(leaves, cameras, backend=backend).image
    image.square().sum().backward()
    gradients = {name: torch.as_tensor(leaf.grad) for name, leaf in vars(leaves).items()}
    return image.detach(), gradients


def step(work: Workload) -> Figures:
    """A fused step's loss and gradients, against autograd through the reference in float64."""
    training = Training(work)
    rows = list(range(work.batch))
    batch = training.frames.batch(rows)
    doubled, theta = copy.deepcopy(training.avatar).double().cpu(), batch.theta.double().cpu()
    at_home = TrainingBatch(
        theta,
        batch.cameras.to(theta),
        batch.images_rgba.cpu(),
        training.background.double(),
    )
    there = TrainingBatch(batch.theta, batch.cameras, batch.images_rgba, training.background)
    start = time.perf_counter()
    loss, moments = _stepped(training.avatar, there, BARE)
    seconds = time.perf_counter() - start
    expected_loss, expected = _stepped(doubled, at_home, _READABLE)
    figures: Figures = {
        "seconds": seconds,
        "loss": loss,
        "loss_difference": abs(loss / expected_loss - 1),
        "gradients": _relative_differences(moments, expected),
    }
    check(figures, figures["loss_difference"] < MOST_OF_A_LOSS, "the loss is another")
    _check_gradients(figures)
    return figures


def _stepped(
    avatar: Avatar, batch: TrainingBatch, options: TrainingOptions
) -> tuple[float, dict[str, Tensor]]:
    """The loss, and Adam's first moments: gradients but for a factor, before any update counts."""
    optimizer = make_optimizer(avatar)
    loss = float(TrainingStep(avatar, optimizer, options)(batch, 0)["l1"])
    groups = avatar.parameter_groups()
    moments = {
        name: torch.cat([optimizer.state[p]["exp_avg"].flatten() for p in parameters])
        for name, parameters in groups.items()
    }
    return loss, moments


def _relative_differences(
    found: Mapping[str, Tensor], expected: Mapping[str, Tensor]
) -> dict[str, float]:
    """The difference's length, in lengths of what is expected; infinite where not finite."""
    out = {}
    for name, right in expected.items():
        there = found[name].double().cpu()
        length = float(right.norm())
        apart = float((there - right).norm())
        out[name] = apart / length if length else apart
    return {n: v if v == v else float("inf") for n, v in out.items()}


def _check_gradients(figures: Figures) -> None:
    for name, apart in figures["gradients"].items():
        check(figures, apart < MOST_OF_A_GRADIENT, f"the gradient of {name} is another")


def replay(work: Workload) -> Figures:
    """The losses of recorded steps, against those of the same steps kernel by kernel."""
    chosen = list(range(work.batch))
    losses = {}
    for name in ("fused", "recorded"):
        training = Training(work)
        batch = training.frames.batch(chosen)
        there = TrainingBatch(batch.theta, batch.cameras, batch.images_rgba, training.background)
        if name == "recorded":
            take, asked = training.unrecorded(), ChosenFrames(chosen, training.background)
        else:
            take, asked = TrainingStep(training.avatar, options=BARE), there
        losses[name] = torch.stack([take(asked, 0)["l1"].clone() for _ in range(STEPS)]).cpu()
    apart = (losses["recorded"] / losses["fused"] - 1).abs()
    figures: Figures = {
        "losses": losses["recorded"].tolist(),
        "largest_difference": float(apart.max()),
    }
    check(figures, bool(apart.max() < MOST_OF_A_LOSS), "replays have other losses")
    check(figures, bool(losses["recorded"][-1] < losses["recorded"][0]), "nothing is learnt")
    return figures
