"""Tiles' lists by the emulated CUDA backend: sorted, of large Gaussians, and too long ones."""

import pytest
import torch
from torch import Tensor

from rgbavatar_ns.kernels.cuda.binning import Bins, Capacities, Images
from rgbavatar_ns.kernels.cuda.source import constants
from tests.kernels.agreement import assert_agrees, expect
from tests.kernels.cuda.emulator import EmulatedLauncher
from tests.kernels.scenes import random_scene, render_and_differentiate

IMAGES = Images(batch=1, count=1, width=16, height=16)


def _bins_values(launcher: EmulatedLauncher, **tensors: Tensor) -> dict:
    empty = Bins(launcher, Capacities(), Images(1, 0, 16, 16), lambda values: None).values()
    return empty | tensors


# Within a warp and across, powers of two and their neighbours, and beyond what shared memory holds.
LENGTHS = [
    0,
    1,
    2,
    3,
    31,
    32,
    33,
    63,
    64,
    65,
    100,
    256,
    257,
    500,
    2047,
    2048,
    2049,
    4096,
    5000,
    8200,
]


@pytest.mark.usefixtures("emulated")
@pytest.mark.parametrize("seed", [0, 1])
def test_lists_of_any_length_are_sorted_in_their_place(seed):
    launcher = EmulatedLauncher()
    launcher.seed = seed
    generator = torch.Generator().manual_seed(seed)
    ends = torch.tensor([0, *LENGTHS]).cumsum(0)
    # Depths often equal, as those of Gaussians that coincide are: then the numbers decide.
    depth = torch.randint(0x3F800000, 0x3F800000 + 300, (int(ends[-1]),), generator=generator)
    entries = depth << 32 | torch.randperm(len(depth), generator=generator)
    wanted = torch.cat([part.sort().values for part in entries.split(LENGTHS)])
    bins = _bins_values(launcher, entries=entries, tile_start=ends.to(torch.int32))
    frame = IMAGES.values() | {"tiles_x": len(LENGTHS), "tiles_y": 1}
    launcher.launch("sort", (len(LENGTHS), 1), frame=frame, bins=bins | {"capacity": len(entries)})
    assert torch.equal(entries, wanted)


def _large(count: int = 40):
    """Most of them over more than the tiles that a thread walks alone."""
    scene = random_scene(11, batch=2, count=count, width=150, height=170, extremes=False)
    scene.gaussians.scales[:, ::2] *= 12
    scene.gaussians.opacities.mul_(0.3)
    return scene


def test_gaussians_over_many_tiles_agree_with_the_reference(emulated):
    expected = expect(_large(), least_settled=0.3)
    assert_agrees(expected, "cuda")
    spans = _spans_of_last_batch(emulated)
    assert (spans > constants()["kTilesAlone"]).sum() > 20
    assert ((spans > 0) & (spans <= constants()["kTilesAlone"])).sum() > 10


def _spans_of_last_batch(emulated) -> Tensor:
    """How many tiles the rectangles of the splats hold."""
    splats, found = [], emulated.emulated
    launch = found.launch

    def watched(kernel, *arguments, **values):
        launch(kernel, *arguments, **values)
        if kernel == "project":
            splats.append(values["bins"]["splats"].clone())

    found.launch = watched
    render_and_differentiate(_large(), torch.float32, "cuda")
    tiles = splats[-1].view(-1, 12)[:, 10:].view(torch.int32)
    first, last = tiles[:, 0], tiles[:, 1]
    across = (last & 0xFFFF) - (first & 0xFFFF) + 1
    return across * ((last >> 16) - (first >> 16) + 1)


def test_what_a_warp_sums_together_does_not_depend_on_the_order_of_threads(emulated):
    found = []
    for seed in (0, 1):
        emulated.emulated.seed = seed
        found.append(render_and_differentiate(_large(), torch.float32, "cuda")[1])
    for name, gradient in found[0].items():
        assert torch.equal(gradient, found[1][name]), name


MOST = constants()["kMostEntries"]


@pytest.mark.parametrize("taken", [MOST, 2**32 + 1, 2**40 + 7])
def test_more_tiles_than_a_number_holds_are_an_overflow_and_told(taken):
    """32 bits would begin again at 0, and lists be written behind their end."""
    launcher = EmulatedLauncher()

    def project(values):
        values["status"][constants()["kSlotsTaken"] :].view(torch.int64).fill_(taken)
        values["tile_count"].fill_(3)

    capacities = Capacities()
    capacities.learn(IMAGES, 10)
    bins = Bins(launcher, capacities, IMAGES, project)
    bins.sort(checked=False)
    assert bins.status.tolist()[constants()["kOverflow"]] == 1
    assert bins.status.tolist()[constants()["kSlotsNeeded"]] == MOST
    with pytest.raises(ValueError, match=r"1 Gaussians touch 2147483647.*fewer or smaller images"):
        capacities.collect()
    # It is told once: what is drawn next need not be as large.
    Bins(launcher, capacities, IMAGES, project)
    assert capacities.skipped_steps == 1
    with pytest.raises(ValueError, match=r"fewer or smaller images"):
        Bins(launcher, capacities, IMAGES, project).sort(checked=True)


def test_what_a_list_needs_is_counted(emulated):
    """A slot for every tile of a Gaussian's rectangle, an entry where it is seen."""
    spans = _spans_of_last_batch(emulated).clamp(min=0)
    capacities = emulated.capacities(torch.device("cpu"))
    room = capacities.per_image[(40, 150, 170)]
    assert room == pytest.approx(1.5 * float(spans.sum()) / 2, abs=2)
