"""What a table of an experiment may show: the heading of each metric, its digits and its words."""

from typing import NamedTuple


class Column(NamedTuple):
    """One metric as tables and plots show it."""

    heading: str
    digits: int
    least_span: float | None = None
    """The least range that a plot's axis covers, so that what nobody sees fills no picture; None
    lets the axis begin at 0, for what is counted from there."""
    told: str = ""
    """What the heading leaves open, as a note below the table."""
    timed: bool = False
    """Whether it depends on how much of the machine there was."""


_FITTED = (
    "theta fitted to each held-out picture first, the avatar frozen; the other columns take theta "
    "as it was tracked"
)
COLUMNS = {
    "psnr": Column("PSNR", 2, 2.0),
    "psnr_refined": Column("PSNR, theta fitted", 2, 2.0, _FITTED),
    "psnr_head": Column("PSNR of the person", 2, 2.0),
    "ssim": Column("SSIM", 4, 0.02),
    "ssim_refined": Column("SSIM, theta fitted", 4, 0.02, _FITTED),
    "lpips_vgg": Column("LPIPS (VGG)", 4, 0.02),
    "lpips_vgg_refined": Column("LPIPS (VGG), theta fitted", 4, 0.02, _FITTED),
    "sharpness": Column(
        "sharpness",
        2,
        told="energy of the pictures' fine structure (what a blur of 1.5 px takes away) within the "
        "person against the film's: 1 is as sharp, less is blurred, more is noise",
    ),
    "sharpness_refined": Column("sharpness, theta fitted", 2, None, _FITTED),
    "l1_streamed": Column("L1, streamed frames", 4),
    "l1_forgotten": Column("L1 forgotten", 5),
    "e_orth": Column("e_orth", 4),
    "steps": Column("steps", 0),
    "images": Column("images", 0),
    "images_per_second": Column("images/s", 1, timed=True),
    "train_seconds": Column("training, s", 0, timed=True),
    "frames_per_second": Column("frames/s", 1, timed=True),
    "peak_mib": Column("memory, MiB", 0),
    "gpu_peak_mib": Column("GPU memory, MiB", 0),
    "gaussians": Column("Gaussians", 0),
    "megabytes": Column(
        "MB", 1, told="all that was learnt, in 10^6 bytes, without the head model, which all share"
    ),
    "aed": Column("AED", 4),
    "apd": Column("APD", 4),
    "csim": Column("CSIM", 4),
}
"""Scores are of the held-out frames. `l1_streamed` is of the frames that a stream brought, after
its end, and `l1_forgotten` how much more that is than each of them ever had; seconds, steps and
images are the training's; `frames_per_second` is from theta to the picture, and memory that of the
training process; the last three need `cross_identity`."""
