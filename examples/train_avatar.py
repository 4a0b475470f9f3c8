"""Train an avatar on a tracked dataset, without nerfstudio: `train_avatar.py DATA OUT`.

DATA is a folder that `rgbavatar track`, `rgbavatar demo-data` or another system wrote. OUT gets the
avatar (a bundle for `Avatar.load`) and held-out frames as film and picture: truth, avatar, error.
"""

import argparse
from pathlib import Path

import torch
from rich.progress import Progress

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.metrics import evaluate_images
from rgbavatar_ns.avatar.training import FitHooks, TrainingBatch, TrainingStep, fit
from rgbavatar_ns.data import ImageCache, OfflineOrder, load_dataset
from rgbavatar_ns.errors import told_without_traceback
from rgbavatar_ns.export import statistics_of, write_comparison
from rgbavatar_ns.head import HeadModel


class Shown(FitHooks):
    """Moves the bar, with the loss beside it now and then: reading it waits for a GPU."""

    def __init__(self, progress: Progress, steps: int) -> None:
        self.progress, self.bar = progress, progress.add_task("training", total=steps)

    def after_step(self, step: int, losses: dict[str, torch.Tensor], seconds: float) -> None:
        """See `FitHooks`."""
        if step % 50 == 0:
            self.progress.update(self.bar, description=f"loss {float(losses['l1']):.4f}")
        self.progress.update(self.bar, completed=step + 1)


def main() -> None:
    """Dataset in, avatar and picture out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--batch-size", type=int, default=10)
    parser.add_argument("--uv-resolution", type=int, default=128, help="256 is the paper's size")
    options = parser.parse_args()
    if options.batch_size < 1:
        parser.error("--batch-size is how many images a step sees: give 1 or more.")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    data = load_dataset(options.data)
    options.out.mkdir(parents=True, exist_ok=True)
    config = AvatarConfig(uv_resolution=options.uv_resolution, scale_from_texel_spacing=True)
    avatar = Avatar(HeadModel(data.arrays), data.identity, config).to(device)
    images = ImageCache(data, budget_bytes=1 << 30)
    order = OfflineOrder(data.train, min(options.batch_size, len(data.train)), seed=0)

    def batch_at(step: int) -> TrainingBatch:
        frames = order.batch(step)
        images.prefetch(order.batch(step + 1))
        cameras = data.cameras.select(frames).to(device)
        return TrainingBatch(data.theta[frames].to(device), cameras, images.get(frames).to(device))

    step = TrainingStep(avatar)
    print(f"Steps are {step.kind}: {step.reason}.")
    with Progress() as progress:
        fit(step, batch_at, range(options.steps), Shown(progress, options.steps))
    avatar.save(options.out / "trained.avatar", statistics=statistics_of(avatar, data))
    print(f"the avatar is in {options.out}")
    scores = []
    for frame in data.test:
        camera = data.cameras.select([frame]).to(device)
        drawn = avatar.render(data.theta[[frame]].to(device), camera).image
        scores.append(evaluate_images(drawn, images.get([frame]).to(device))["psnr"])
    images.close()
    if scores:
        print(f"held-out PSNR {sum(scores) / len(scores):.2f} dB over {len(scores)} frames")
        write_comparison(avatar, data, options.out / "held_out.mp4", options.out / "held_out.png")


if __name__ == "__main__":
    with told_without_traceback("train_avatar.py"):
        main()
