"""What refining the tracking while training is worth, on the demo subject or a tracked dataset.

    python benchmarks/quality/refinement.py --json refinement.json
    python benchmarks/quality/refinement.py --data FOLDER

Without --data the demo subject is rendered and its theta, which is known, made as noisy as a poor
tracker's, training and held-out frames alike. An avatar is trained without and with refinement, and
scored on held-out frames: driven by what the tracker said ("tracked"), by that after the linear
map that refinement has learnt from the training frames ("calibrated", the method's own score), by
theta fitted to the held-out images with the avatar frozen ("fitted"), and, where it is known, by
the truth ("true": what the avatar is worth, which noise in the held-out frames' theta hides).

The error of theta is the root mean square over the training frames, each number's mean error taken
out, since an avatar may agree with any constant offset; that of vertices likewise, in millimetres,
once as they are and once of the face in its own frame ("face_mm": the pose made right). Rotation
and neck turn the same head about near points, so that vertices tell more than either.
"""

import argparse
import statistics
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import Progress
from subject import BATCH_SIZE, Subject, write_figures

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.metrics import evaluate_images
from rgbavatar_ns.avatar.refinement import FrameRefinement, RefinementConfig
from rgbavatar_ns.avatar.training import (
    TrainingBatch,
    TrainingOptions,
    TrainingStep,
    fit,
    make_optimizer,
)
from rgbavatar_ns.avatar.training.theta_fit import fit_theta
from rgbavatar_ns.data import TrackedDataset, load_dataset
from rgbavatar_ns.export.comparison import write_comparison
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset
from rgbavatar_ns.synthetic.performer.performance import with_tracker_noise

LAST_RATE = 0.1


@dataclass(frozen=True)
class Tracked:
    """A subject whose dataset holds theta as a tracker found it, and the dataset's own theta."""

    subject: Subject
    true_theta: torch.Tensor

    @classmethod
    def of(cls, dataset: TrackedDataset, noise: float, seed: int) -> "Tracked":
        """Read the images; make theta noisy where `noise` is not zero."""
        theta = dataset.theta
        if noise > 0:
            names = dataset.arrays.expression_names
            noisy = with_tracker_noise(theta.double().numpy(), dataset.layout, names, noise, seed)
            theta = torch.from_numpy(np.asarray(noisy)).float()
        return cls(Subject.of(replace(dataset, theta=theta), seed), dataset.theta)

    @property
    def dataset(self) -> TrackedDataset:
        """With theta as tracked."""
        return self.subject.dataset

    def of_training(self) -> torch.Tensor:
        """Theta of the training frames."""
        return self.dataset.theta[list(self.dataset.train)]

    def of_held_out(self) -> torch.Tensor:
        """Theta of the held-out frames."""
        return self.dataset.theta[list(self.dataset.test)]


def train(
    subject: Subject, steps: int, uv_resolution: int, refinement: FrameRefinement | None
) -> tuple[Avatar, float]:
    """Train as `rgbavatar-tiny` does, correcting theta where there is a refinement; and seconds."""
    config = AvatarConfig(uv_resolution=uv_resolution, scale_from_texel_spacing=True)
    avatar, order = subject.avatar(config), subject.offline()
    optimizer = make_optimizer(avatar)
    first_rates = [group["lr"] for group in optimizer.param_groups]
    options = TrainingOptions(seed=subject.seed)
    take = TrainingStep(avatar, optimizer, options, refinement=refinement)
    with Progress() as progress:
        bar = progress.add_task("with" if refinement else "without", total=steps)

        def batch(step: int) -> TrainingBatch:
            progress.update(bar, completed=step + 1)
            for group, rate in zip(optimizer.param_groups, first_rates):
                group["lr"] = rate * LAST_RATE ** (step / steps)
                if refinement is None:
                    continue
                if step < refinement.frames.config.first_step_of(group["name"], steps):
                    group["lr"] = 0.0
            return subject.batch(order.batch(step))

        started = time.monotonic()
        fit(take, batch, range(steps))
    return avatar, time.monotonic() - started


@torch.no_grad()
def scores(tracked: Tracked, avatar: Avatar, theta: torch.Tensor) -> dict[str, float]:
    """Mean scores of the held-out frames, driven by `theta`."""
    found: dict[str, list[float]] = {"psnr": [], "psnr_head": []}
    for row, position in enumerate(tracked.dataset.test):
        camera = tracked.dataset.cameras.select([position])
        image = avatar.render(theta[[row]], camera).image
        values = evaluate_images(image, tracked.subject.images[[position]])
        for name in found:
            found[name].append(float(values[name] or 0.0))
    return {name: statistics.fmean(values) for name, values in found.items()}


def fitted(
    tracked: Tracked, avatar: Avatar, theta: torch.Tensor, steps: int, config: RefinementConfig
) -> torch.Tensor:
    """The held-out frames' theta from `theta`, fitted to their images."""
    parts = []
    for rows in torch.arange(len(theta)).split(BATCH_SIZE):
        positions = [tracked.dataset.test[row] for row in rows]
        cameras = tracked.dataset.cameras.select(positions)
        images = tracked.subject.images[positions]
        reference = tracked.of_training()
        part = fit_theta(
            avatar, theta[rows], cameras, images, steps, config=config, reference=reference
        )
        parts.append(part)
    return torch.cat(parts)


@torch.no_grad()
def errors(tracked: Tracked, theta: torch.Tensor) -> dict[str, float]:
    """How far the training frames' theta is from the truth, by field, and their vertices in mm."""
    dataset = tracked.dataset
    truth = tracked.true_theta[list(dataset.train)]
    layout, head = dataset.layout, HeadModel(dataset.arrays)
    found = {}
    for name in layout.names:
        part = (theta - truth)[:, layout.slice(name)]
        part = part[:, truth[:, layout.slice(name)].std(0) > 1e-6]
        if part.numel():
            found[name] = float((part - part.mean(0)).square().mean().sqrt())
    still = theta.clone()
    for name in ("rotation", "neck", "translation"):
        still[:, layout.slice(name)] = truth[:, layout.slice(name)]
    for name, driven in (("vertices_mm", theta), ("face_mm", still)):
        apart = head(driven, dataset.identity) - head(truth, dataset.identity)
        apart = apart - apart.mean(0)
        found[name] = 1e3 * float(apart.square().sum(-1).mean().sqrt())
    return found


def measure(tracked: Tracked, arguments: argparse.Namespace, noisy: bool) -> dict[str, Any]:
    """Both trainings and all their figures."""
    config = RefinementConfig()
    rows: dict[str, Any] = {}
    for name in ("without", "with"):
        refinement = None
        if name == "with":
            dataset = tracked.dataset
            refinement = FrameRefinement(dataset.theta, dataset.train, dataset.layout, config)
        avatar, seconds = train(
            tracked.subject, arguments.steps, arguments.uv_resolution, refinement
        )
        theta = tracked.of_held_out()
        row = {"train_seconds": seconds, "tracked": scores(tracked, avatar, theta)}
        if refinement is not None:
            theta = refinement.frames.calibrated(theta)
            row["calibrated"] = scores(tracked, avatar, theta)
        fitted_theta = fitted(tracked, avatar, theta, arguments.fit_steps, config)
        row["fitted"] = scores(tracked, avatar, fitted_theta)
        if noisy:
            row["true"] = scores(tracked, avatar, tracked.true_theta[list(tracked.dataset.test)])
            found = tracked.of_training() if refinement is None else refinement.frames.theta()
            row["error"] = errors(tracked, found)
        if arguments.pictures:
            _picture(tracked, avatar, theta, arguments.pictures / f"{name}.png")
            _picture(tracked, avatar, fitted_theta, arguments.pictures / f"{name}_fitted.png")
        rows[name] = row
    return rows


def _picture(tracked: Tracked, avatar: Avatar, theta: torch.Tensor, path: Path) -> None:
    """Held-out frames beside the avatar driven by `theta`."""
    whole = tracked.dataset.theta.clone()
    whole[list(tracked.dataset.test)] = theta
    path.parent.mkdir(parents=True, exist_ok=True)
    write_comparison(avatar, replace(tracked.dataset, theta=whole), path.with_suffix(".mp4"), path)


def tell(rows: dict[str, Any]) -> None:
    """Print the table: PSNR over the full frame and over the head, then the errors of theta."""
    print(f"{'held-out PSNR / of the head, dB':<34}{'without':>16}{'with refinement':>20}")
    for name in ("tracked", "calibrated", "fitted", "true"):
        cells = [
            f"{row[name]['psnr']:.2f} / {row[name]['psnr_head']:.2f}" if name in row else "-"
            for row in rows.values()
        ]
        if cells == ["-", "-"]:
            continue
        print(f"{name:<34}{cells[0]:>16}{cells[1]:>20}")
    if "error" in rows["with"]:
        before, after = rows["without"]["error"], rows["with"]["error"]
        print(f"{'error of theta in training frames':<34}{'before':>16}{'after':>20}{'left':>8}")
        for name, value in before.items():
            left = after[name] / value
            print(f"{name:<34}{value:>16.5f}{after[name]:>20.5f}{left:>8.0%}")
    seconds = [row["train_seconds"] for row in rows.values()]
    print(f"{'training, s':<34}{seconds[0]:>16.0f}{seconds[1]:>20.0f}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, help="a tracked dataset in place of the demo subject")
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--fit-steps", type=int, default=60)
    parser.add_argument("--uv-resolution", type=int, default=128)
    parser.add_argument("--frames", type=int, default=160, help="of the demo subject")
    parser.add_argument("--image-size", type=int, default=256, help="of the demo subject")
    parser.add_argument("--noise", type=float, default=6.0, help="6: .6 degrees, .6 mm, .06")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of held-out frames")
    arguments = parser.parse_args()
    noisy = arguments.data is None
    with tempfile.TemporaryDirectory() as folder:
        if noisy:
            demo = DemoConfig(
                image_size=arguments.image_size,
                num_frames=arguments.frames,
                num_test_frames=arguments.frames // 4,
                seed=arguments.seed,
                theta_noise=0.0,
            )
            dataset = make_demo_dataset(Path(folder) / "subject", demo)
        else:
            dataset = load_dataset(arguments.data)
        tracked = Tracked.of(dataset, arguments.noise if noisy else 0.0, arguments.seed)
        rows = measure(tracked, arguments, noisy)
    tell(rows)
    write_figures(arguments.json, arguments, rows=rows)


if __name__ == "__main__":
    main()
