"""What of the benchmarks can be chosen; no heavy imports, so that help is shown at once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Between, CheckedOptions, Count, Counted, Pixels, Seed

_Threads = Annotated[int, Between(1, 4096)]
_Batch = Annotated[int, Between(1, 4096)]


@dataclass(frozen=True)
class CommonOptions(CheckedOptions):
    """Choices of every benchmark."""

    json: Path | None = None
    """Also write the figures here."""
    avatar: Path | None = None
    """Measure a trained avatar: a run's folder, a checkpoint or a bundle."""
    data: Path | None = None
    """Dataset whose theta and camera drive the avatar; without it small random theta."""
    size: Pixels | None = None
    """Side of the images in pixels: 512, or the dataset's."""
    threads: _Threads | None = None
    """Threads to use; as many as torch takes by default."""
    device: Literal["cpu", "cuda"] | None = None
    """Where to measure; the GPU where it can be used, else the CPU."""


@dataclass(frozen=True)
class RasterizerOptions(CommonOptions):
    """The rasterizer alone, forward and backward, beside its peers.

    The workload: Gaussians on an ellipsoid that fills about 60 % of the image, anisotropic, mean
    3-sigma radii of 5.4 and 3.0 pixels at 512 x 512, opacity U(.1, .95), another set for every
    image, one camera, gradients to all attributes; or a trained avatar's Gaussians (--avatar).
    """

    count: Count | None = None
    """Gaussians in a set of the synthetic workload: 60,000."""
    batch: _Batch = 10
    """Sets, and images, at a time."""
    shared: bool = False
    """Share opacities and scales within the batch, as an avatar does."""
    backend: str = "auto"
    """Backend of the rasterizer."""
    repetitions: Count = 15
    """Timings of each kind, after a warm-up."""
    peers: bool = True
    """Also measure the peers, on one image of the workload."""
    peer_repetitions: Count = 2
    """Timings of each peer, after a warm-up; they take seconds each."""

    def __post_init__(self) -> None:
        """Refuse what cannot be measured or would be ignored."""
        super().__post_init__()
        if self.avatar is None and self.data is not None:
            raise UserError(
                "--data drives an avatar, but none is named.", "Pass --avatar too, or neither."
            )
        if self.avatar is not None and (self.count is not None or self.shared):
            raise UserError(
                "--count and --shared belong to the synthetic workload, not to an avatar.",
                "Leave them out, or leave out --avatar.",
            )


@dataclass(frozen=True)
class AvatarOptions(CommonOptions):
    """Choices of the benchmarks that need a whole avatar."""

    uv: Annotated[int, Between(1, 4096)] | None = None
    """Side of the UV map of the avatar that is made for the benchmark: 256."""
    bases: Counted | None = None
    """Its number of blendshapes: 20."""

    def __post_init__(self) -> None:
        """Refuse what would be ignored."""
        super().__post_init__()
        if self.avatar is not None and (self.uv is not None or self.bases is not None):
            raise UserError(
                "--uv and --bases belong to the avatar that is made for the benchmark.",
                "Leave them out: the one given with --avatar has its own.",
            )


@dataclass(frozen=True)
class StepOptions(AvatarOptions):
    """A whole training step: theta and uint8 pictures in, changed parameters out.

    The workload: the embedded head with one Gaussian a texel and random pictures; or a trained
    avatar (--avatar) and the pictures of its dataset (--data).
    """

    batch: _Batch = 10
    """Images a step."""
    repetitions: Count = 15
    """Timings of each kind, after a warm-up."""
    trainer: bool = False
    """Also train with nerfstudio's trainer, and say what share of the bare step's speed it has."""
    trainer_steps: Count = 100
    """Steps of that training."""


@dataclass(frozen=True)
class RenderOptions(AvatarOptions):
    """From theta to the image, one image at a time, without gradients."""

    frames: Count = 10
    """Different theta that are drawn in turn."""
    repetitions: Count = 50
    """Timings of each kind, after a warm-up."""


@dataclass(frozen=True)
class Batches:
    """Images a step: `first` for some seconds, then `then`."""

    name: str
    first: int
    until_s: float
    then: int

    @classmethod
    def parsed(cls, text: str) -> "Batches":
        """`10`, or `4-10:20`; raises UserError for anything else."""
        sizes, _, seconds = text.partition(":")
        first, _, then = sizes.partition("-")
        try:
            found = cls(text, int(first), float(seconds or 0), int(then or first))
        except ValueError:
            found = None
        if found is None or min(found.first, found.then) < 1 or not found.until_s >= 0:
            raise UserError(
                f"--batches {text!r} is no number of images a step.",
                "Pass one like 10, or 4-10:20 for 4 in the first 20 seconds and 10 from then on.",
            )
        return found


@dataclass(frozen=True)
class QualityOptions(CheckedOptions):
    """How good an avatar is after so many seconds, by images a step: curves and time to quality.

    PSNR of frames held out, of procedural people or of your own dataset. Seconds are those of
    training steps alone; on a CPU the processor's, so that what else runs changes little. Learning
    rates fall to a tenth. Time to quality is when a curve is within .5 dB of its end.
    """

    json: Path | None = None
    """Also write the figures here, curve by curve; interrupted, the command goes on from them."""
    data: Path | None = None
    """Dataset to learn and its held-out frames, in place of procedural people."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Procedural people, or with --data seeds of what is random in training."""
    batches: tuple[str, ...] = ("10", "4")
    """Images a step: 10, or 4-10:20 for 4 in the first 20 seconds and 10 from then on."""
    seconds: Annotated[float, Between(0, 1e6, open=True)] = 24.0
    """How long each avatar is trained."""
    size: Pixels | None = None
    """Side of the procedural images in pixels: 256."""
    uv: Annotated[int, Between(1, 4096)] = 128
    """Side of the avatars' UV map: root of about the number of Gaussians."""
    threads: _Threads = 1
    """Threads to use; with more than one, seconds are those of the clock."""
    device: Literal["cpu", "cuda"] | None = None
    """Where to train; the GPU where it can be used, else the CPU."""

    def __post_init__(self) -> None:
        """Refuse what cannot be measured or would be ignored."""
        super().__post_init__()
        for text in self.batches:
            Batches.parsed(text)
        if not self.batches or not self.seeds:
            raise UserError("Nothing is to be trained.", "Name at least one of --batches, --seeds.")
        if self.data is not None and self.size is not None:
            raise UserError(
                "--size belongs to the procedural people, not to a dataset.", "Leave it out."
            )
