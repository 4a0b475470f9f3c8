"""Whether images and parameters are of the same moments."""

from collections import Counter
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from rgbavatar_ns.data.check.problems import Problem
from rgbavatar_ns.data.check.sample import Sample, projected
from rgbavatar_ns.data.native.dataset import TrackedDataset

LARGEST_OFFSET = 2
MAX_FRAMES = 90
"""More frames of a run make the answer no surer."""
_LEAST_FRAMES, _LEAST_MOTION_PX = 16, 0.02
_SURE, _BETTER = 0.5, 0.12


def longest_run(dataset: TrackedDataset) -> tuple[int, ...]:
    """Positions of frames that follow one another, of one camera; at most `MAX_FRAMES`."""
    names = dataset.camera_names or ("",) * len(dataset)
    camera = Counter(names).most_common(1)[0][0]
    moments = dataset.moments
    ordered = sorted(
        (moments[position], position) for position, name in enumerate(names) if name == camera
    )
    step = Counter(b[0] - a[0] for a, b in pairwise(ordered)).most_common(1)
    best: list[int] = []
    run: list[int] = []
    previous = None
    for moment, position in ordered:
        if previous is None or moment - previous != step[0][0]:
            run = []
        run.append(position)
        previous = moment
        if len(run) > len(best):
            best = list(run)
    return tuple(best[:MAX_FRAMES])


def frame_offset_problem(run: Sample) -> Problem | None:
    """Compare when the images move with when the head's vertices do, for offsets of two frames."""
    if len(run) < _LEAST_FRAMES:
        return None
    motion = np.linalg.norm(np.diff(projected(run).points_px, axis=0), axis=-1).mean(1)
    change = np.abs(np.diff(run.gray, axis=0)).mean((1, 2))
    if motion.mean() < _LEAST_MOTION_PX:
        return None
    offsets = range(-LARGEST_OFFSET, LARGEST_OFFSET + 1)
    agreed = {k: offset_agreement(np.sqrt(motion), np.sqrt(change), k) for k in offsets}
    best = max(offsets, key=lambda k: agreed[k])
    if best == 0 or agreed[best] < _SURE or agreed[best] - agreed[0] < _BETTER:
        return None
    frames = f"{abs(best)} frame{'s' if abs(best) > 1 else ''}"
    return Problem(
        "frame offset",
        "error",
        f"Images and parameters are {frames} apart: image i shows what the parameters of frame "
        f"i {'+' if best > 0 else '-'} {abs(best)} say (their motion agrees by {agreed[best]:.2f} "
        f"there, by {agreed[0]:.2f} as they are).",
        "Check which image belongs to which parameters; some systems count images from 1 and "
        "parameters from 0.",
    )


def offset_agreement(
    motion: Float[np.ndarray, "n"], change: Float[np.ndarray, "n"], offset: int
) -> float:
    """Correlation of the head's motion `offset` frames later with the images' change."""
    count = len(motion) - abs(offset)
    later, earlier = max(offset, 0), max(-offset, 0)
    a, b = motion[later : later + count], change[earlier : earlier + count]
    if a.std() < 1e-9 or b.std() < 1e-9:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])
