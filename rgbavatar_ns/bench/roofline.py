"""The least time that a workload could take on this machine, from its speed measured here."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.benchmark import Timer

from rgbavatar_ns.bench.timing import CPU
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras

FORWARD_OPERATIONS_PER_PAIR = 16
"""Vector operations a pair, were every lane useful: offset 2, exponent from the folded conic 4,
exp2 by a short polynomial 4, cut 1, weight and transmittance 2, colours 3."""

BACKWARD_OPERATIONS_PER_PAIR = 35
"""Alpha again 11, weight and transmittance 2, g . c 3, remainder 1, gradients of alpha 4 and of
the exponent 1, of the colour 3, moments of the exponent's gradient for mean and conic 10."""

_FLOAT_BYTES = 4


@dataclass(frozen=True)
class MachineSpeed:
    """What the machine does on the threads in use.

    `lane_operations_per_second` counts one fused multiply-add of one float32 lane as one:
    instructions times lanes.
    """

    lane_operations_per_second: float
    bytes_per_second: float


def measure_speed(
    device: torch.device = CPU,
    matrix_side: int | None = None,
    copy_mib: int | None = None,
    seconds: float = 0.5,
) -> MachineSpeed:
    """Arithmetic from a large float32 matrix product, bandwidth from a large copy.

    The best of what fits into so many seconds each, by default with sizes that keep the device
    busy. A copy counts its bytes twice, read and written.
    """
    large = device.type == "cuda"
    matrix_side = matrix_side or (8192 if large else 2048)
    copy_mib = copy_mib or (2048 if large else 256)
    factor = torch.randn(matrix_side, matrix_side, device=device)
    product = torch.empty_like(factor)
    source = torch.ones(copy_mib << 18, device=device)
    target = torch.zeros_like(source)

    def least_seconds(statement: str, **values: Tensor) -> float:
        scope: dict[str, Any] = {"torch": torch, **values}
        timer = Timer(statement, globals=scope, num_threads=torch.get_num_threads())
        return min(timer.blocked_autorange(min_run_time=seconds).times)

    multiply_s = least_seconds("torch.mm(a, a, out=b)", a=factor, b=product)
    copy_s = least_seconds("b.copy_(a)", a=source, b=target)
    return MachineSpeed(
        lane_operations_per_second=matrix_side**3 / multiply_s,
        bytes_per_second=2 * _FLOAT_BYTES * source.numel() / copy_s,
    )


@dataclass(frozen=True)
class Work:
    """What must be done for a batch: lane operations and bytes between memory and processor."""

    operations: int
    moved_bytes: int

    def seconds(self, speed: MachineSpeed) -> float:
        """The longer of the two, since they can overlap."""
        return max(
            self.operations / speed.lane_operations_per_second,
            self.moved_bytes / speed.bytes_per_second,
        )


def rasterizer_work(
    pairs: int, gaussians: GaussianSet, cameras: PinholeCameras, *, backward: bool
) -> Work:
    """The rasterizer's part for a batch with `pairs` pairs in all.

    Inputs are read and image and alpha written once; for the backward pass the inputs, image,
    alpha and the image's gradient are read and the gradients written once.
    """
    inputs = sum(value.numel() for value in vars(gaussians).values())
    batch = max(len(value) for value in vars(gaussians).values())
    pixels = max(batch, len(cameras.focal_px)) * cameras.width * cameras.height
    operations, floats = FORWARD_OPERATIONS_PER_PAIR * pairs, inputs + 4 * pixels
    if backward:
        operations += BACKWARD_OPERATIONS_PER_PAIR * pairs
        floats += 2 * inputs + 7 * pixels
    return Work(operations, _FLOAT_BYTES * floats)


def update_work(parameters: list[nn.Parameter], targets: Tensor) -> Work:
    """The rest of a training step: p, m and v of Adam read and written, the targets read, once.

    The blend's multiply-adds, three a basis value and image, hide under these 24 bytes a value.
    """
    values = sum(parameter.numel() for parameter in parameters)
    return Work(0, 6 * _FLOAT_BYTES * values + targets.numel() * targets.element_size())


def parameter_work(parameters: list[nn.Parameter]) -> Work:
    """Drawing from theta, beside the rasterizer: every parameter is read once."""
    return Work(0, _FLOAT_BYTES * sum(parameter.numel() for parameter in parameters))


def roofline_figures(
    works: list[Work],
    speed: MachineSpeed,
    images: int,
    reached_ms_per_image: float,
    pairs_per_image: float,
) -> dict[str, Any]:
    """The least time of stages that follow one another, as JSON holds it.

    `reached` is its share of the time that was taken.
    """
    least_ms = 1e3 * sum(work.seconds(speed) for work in works) / images
    operations = sum(work.operations for work in works)
    moved = sum(work.moved_bytes for work in works)
    return {
        "ms_per_image": least_ms,
        "reached": least_ms / reached_ms_per_image,
        "arithmetic_ms_per_image": 1e3 * operations / speed.lane_operations_per_second / images,
        "traffic_ms_per_image": 1e3 * moved / speed.bytes_per_second / images,
        "pairs_per_image": pairs_per_image,
        "lane_operations_per_second": speed.lane_operations_per_second,
        "bytes_per_second": speed.bytes_per_second,
    }
