"""What is hoped for at the paper's size, and how far a figure is from it."""

from benchmarks.gpu.rows import Figures

IMAGES_PER_SECOND = (3000.0, 6000.0)
"""Of whole training steps (the release on an RTX 3090: 630)."""
FRAMES_PER_SECOND = (1500.0,)
"""From theta to image."""
AVATAR_SECONDS = (15.0, 10.0)
"""For 50,000 images."""
AVATAR_IMAGES = 50_000


def at_least(figure: float, targets: tuple[float, ...]) -> Figures:
    """The figure's share of each target; 1 or more has reached it."""
    return {f"of_{target:g}": figure / target for target in targets}


def at_most(figure: float, targets: tuple[float, ...]) -> Figures:
    """Each target's share of the figure; 1 or more has reached it."""
    return {f"of_{target:g}_s": target / figure for target in targets}
