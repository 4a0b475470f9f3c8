"""Replays while other memory comes and goes: a graph that reads what it does not hold is found."""

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.gpu.rows import Figures, Rows, check
from benchmarks.gpu.workload import Training, Workload
from rgbavatar_ns.avatar.recorded_rendering import RecordedRendering

_SIZES = (1 << 7, 1 << 12, 1 << 18, 1 << 22)
"""Floats of a tensor: one for each kind of block that torch's allocator keeps, on a GPU."""
_OFTEN = 4
"""Calls between two times that all free memory is handed back to the driver."""
MOST_OF_THE_SAME = 1e-6
"""Where even two equal runs differ: torch's sums for the weight network may change their order."""


def churn(rows: Rows) -> None:
    """Training and pictures, with and without."""
    work = Workload.here()
    for name, run in {"training": trained, "pictures": pictured}.items():
        with rows.row(name) as figures:
            figures |= compared(run, work)


def compared(
    run: Callable[[Workload, Callable[[int], None]], list[Tensor]], work: Workload
) -> Figures:
    """Two runs by themselves and one among others' tensors, all with the same start."""
    alone, again = run(work, _nothing), run(work, _nothing)
    among = run(work, lambda number: disturb(work, number))
    repeatable, apart = _difference(alone, again), _difference(alone, among)
    figures: Figures = {
        "two_runs_differ_by": repeatable,
        "churned_differs_by": apart,
        "bits_are_the_same": apart == 0,
    }
    allowed = 0.0 if repeatable == 0 else max(MOST_OF_THE_SAME, 2 * repeatable)
    check(figures, apart <= allowed, "what others do with their memory changes the results")
    return figures


def _nothing(number: int) -> None:
    pass


def _difference(left: list[Tensor], right: list[Tensor]) -> float:
    apart = max(float((a.double() - b.double()).abs().max()) for a, b in zip(left, right))
    return apart if apart == apart else float("inf")


def disturb(work: Workload, number: int) -> None:
    """Take memory of many sizes, fill it with NaN, and free it.

    At times what other streams have freed is handed back before, so that it may be taken here.
    """
    if work.on_gpu and number % _OFTEN == 0:
        torch.cuda.empty_cache()
    sizes = _SIZES if work.on_gpu else _SIZES[:2]
    taken = [torch.full((size,), torch.nan, device=work.device) for size in sizes for _ in range(3)]
    del taken


def trained(work: Workload, between: Callable[[int], None]) -> list[Tensor]:
    """Losses and parameters after recorded steps."""
    training = Training(work)
    take, losses = training.recorded(), []
    for number in range(work.calls):
        between(number)
        losses.append(take()["l1"])
    return [torch.stack(losses), *(p.detach() for p in training.avatar.parameters())]


@torch.no_grad()
def pictured(work: Workload, between: Callable[[int], None]) -> list[Tensor]:
    """Recorded pictures, one after another."""
    training = Training(work)
    frames = training.frames
    draw = RecordedRendering(
        training.avatar, frames.theta[:1], frames.cameras, backend="cuda", recorder=work.recorder
    )
    pictures = []
    for number in range(work.calls):
        between(number)
        row = number % work.frames
        pictures.append(draw(frames.theta[row : row + 1]).image.clone())
    return pictures
