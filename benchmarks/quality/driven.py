"""How well an avatar follows another person: mouth, lids and turns of both, frame by frame.

    python benchmarks/quality/driven.py RUN SOURCE [SOURCE ...] [--pictures FOLDER]

SOURCE is a video or a dataset (or a run that names one). The same steps as `rgbavatar drive` make
the avatar's theta; printed are the correlations of performer and avatar, each on its own mesh: gap
of the lips and of the eyes' lids along the face's height, yaw and pitch of the head about its mean.
Beside them how far both go (standard deviations). --pictures writes films with the performer beside
the avatar. For heads of which FaceMesh's landmarks are known: the embedded ones.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.driving.live_drive import DrivenFrame
from rgbavatar_ns.driving.live_transfer import LiveTransfer
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.driving.sources.dataset import dataset_source
from rgbavatar_ns.export import dataset_folder
from rgbavatar_ns.export.live_pictures import FilmSink, PictureOutput
from rgbavatar_ns.export.subject import load_subject
from rgbavatar_ns.head import HeadModel, facemesh_landmarks
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.tracking.performer import FilmedPerformer

_RATE = 25.0
_OPENINGS = {"lips": (13, 14), "left lids": (386, 374), "right lids": (159, 145)}
"""FaceMesh's points above and below."""


def main(
    run: Annotated[Path, tyro.conf.Positional],
    sources: Annotated[list[Path], tyro.conf.Positional],
    pictures: Path | None = None,
) -> None:
    """Let each source drive the avatar."""
    subject = load_subject(run, None)
    print("performer, frames: correlation (standard deviation of performer -> avatar; mm, degrees)")
    for source in sources:
        head, frames = _performed(source, subject.camera.height)
        transfer = LiveTransfer(subject.avatar, subject.seen, head, subject.camera)
        driven = torch.stack([transfer(frame) for frame in frames])
        theta = torch.stack([frame.theta for frame in frames if frame.theta is not None])
        nobody = torch.zeros(head.arrays.num_identity)
        first = _measures(HeadModel(head.arrays), nobody, theta)
        second = _measures(subject.avatar.head, subject.avatar.identity, driven)
        told = [
            f"{name} {np.corrcoef(first[name], second[name])[0, 1]:.3f} "
            f"({first[name].std():.1f} -> {second[name].std():.1f})"
            for name in first
        ]
        print(f"{source.name}, {len(frames)}: " + ", ".join(told), flush=True)
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            sink = FilmSink(pictures / f"{source.stem}.mp4", _RATE)
            output = PictureOutput(subject.avatar, subject.camera, (1.0, 1.0, 1.0), sink, True)
            for frame, row in zip(frames, driven):
                shown = DrivenFrame(frame.index, row, 0.0, frame.time_s, frame.image_rgb)
                output.show(shown)
            output.close()


def _performed(source: Path, image_height_px: int) -> tuple[PerformerHead, list[PerformanceFrame]]:
    """All frames of a video or a dataset, with pictures of this height."""
    if source.is_dir():
        performer = dataset_source(dataset_folder(source), _RATE, False, image_height_px)
    else:
        performer = FilmedPerformer(str(source), False, image_height_px)
    frames = []
    while not performer.ended:
        frame = performer.next(1.0)
        if frame is not None:
            frames.append(frame)
    performer.close()
    assert performer.head is not None
    return performer.head, frames


@torch.no_grad()
def _measures(
    head: HeadModel, identity: Float[Tensor, "I"], theta: Float[Tensor, "F H"]
) -> dict[str, np.ndarray]:
    """Openings in millimetres, turns in degrees, of each frame."""
    marks, still = facemesh_landmarks(), theta.clone()
    for name in ("rotation", "neck", "translation"):
        still[:, head.layout.slice(name)] = 0
    heights = head(still, identity)[..., 1]
    found: dict[str, np.ndarray] = {}
    for name, pair in _OPENINGS.items():
        rows = [int(np.flatnonzero(marks.facemesh_index == index)[0]) for index in pair]
        corners = torch.from_numpy(head.arrays.faces[marks.triangle[rows]].astype(np.int64))
        weights = torch.from_numpy(marks.barycentric[rows]).to(heights)
        above, below = (heights[:, corners] * weights).sum(-1).unbind(1)
        found[name] = (1e3 * (above - below)).numpy()
    turns = [axis_angle_to_matrix(theta[:, head.layout.slice(n)]) for n in ("rotation", "neck")]
    ahead = (turns[0] @ turns[1])[:, :, 2].numpy()  # where the face looks
    mean = ahead.mean(0) / np.linalg.norm(ahead.mean(0))
    side = np.cross([0.0, 1.0, 0.0], mean)
    side /= np.linalg.norm(side)
    found["yaw"] = np.degrees(np.arctan2(ahead @ side, ahead @ mean))
    found["pitch"] = np.degrees(np.arctan2(ahead @ np.cross(mean, side), ahead @ mean))
    return found


if __name__ == "__main__":
    tyro.cli(main)
