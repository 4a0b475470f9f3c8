"""A dataset in memory and what is asked of avatars of it: shared by the scripts beside this one."""

import argparse
import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar import AvatarConfig
from rgbavatar_ns.avatar.metrics import psnr
from rgbavatar_ns.avatar.training import TrainingBatch
from rgbavatar_ns.bench.machine import machine_facts
from rgbavatar_ns.data import OfflineOrder, TrackedDataset
from rgbavatar_ns.drawing.compositing import film_over
from rgbavatar_ns.head import HeadModel

BATCH_SIZE = 10


@dataclass(frozen=True)
class Subject:
    """A dataset with its images in memory, and the seed of what is random in training on it."""

    dataset: TrackedDataset
    images: Tensor
    seed: int

    @classmethod
    def of(cls, dataset: TrackedDataset, seed: int) -> "Subject":
        """Read the images."""
        images = [torch.as_tensor(dataset.read_image(i)) for i in range(len(dataset))]
        return cls(dataset, torch.stack(images), seed)

    def avatar(self, config: AvatarConfig) -> Avatar:
        """A fresh one."""
        head = HeadModel(self.dataset.arrays)
        return Avatar(head, self.dataset.identity, config, seed=self.seed)

    def offline(self) -> OfflineOrder:
        """The training frames step by step, as `ns-train` takes them."""
        return OfflineOrder(self.dataset.train, BATCH_SIZE, self.seed)

    def batch(self, positions: Sequence[int]) -> TrainingBatch:
        """These frames."""
        chosen = list(positions)
        cameras = self.dataset.cameras.select(chosen)
        return TrainingBatch(
            self.dataset.theta[chosen],
            cameras,
            self.images[chosen],
            position=torch.tensor(chosen),
        )

    @torch.no_grad()
    def shown(
        self, avatar: Avatar, positions: Sequence[int]
    ) -> tuple[Float[Tensor, "B H W 3"], Float[Tensor, "B H W 3"]]:
        """Drawn and filmed frames over black."""
        batch = self.batch(positions)
        image = avatar.render(batch.theta, batch.cameras).image.clamp(0, 1)
        black = torch.zeros(len(positions), 3)
        return image, film_over(batch.images_rgba, black, image)

    def psnr(self, avatar: Avatar, positions: Sequence[int]) -> float:
        """Mean PSNR in dB over these frames: full frame, black background."""
        scores: list[float] = []
        for start in range(0, len(positions), BATCH_SIZE):
            scores += psnr(*self.shown(avatar, positions[start : start + BATCH_SIZE])).tolist()
        return statistics.fmean(scores)


def write_figures(path: Path | None, arguments: argparse.Namespace, **figures: Any) -> None:
    """Write figures with their settings and machine as JSON, where a path is given."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    settings = {name: str(value) for name, value in vars(arguments).items()}
    content = {"settings": settings, "machine": machine_facts(), **figures}
    path.write_text(json.dumps(content, indent=2) + "\n")


def write_picture(path: Path, image: Float[np.ndarray, "height width 3"]) -> None:
    """Write RGB values from 0 to 1; ends the script where a path cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = (image * 255 + 0.5).astype(np.uint8)
    if not cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)):
        raise SystemExit(f"{path} cannot be written.")


def avatars_and_datasets(
    parser: argparse.ArgumentParser, named: Sequence[Path]
) -> list[tuple[Path, Path]]:
    """Paths that were named by turns."""
    if len(named) % 2:
        parser.error("Name a dataset after each avatar.")
    return list(zip(named[::2], named[1::2]))
