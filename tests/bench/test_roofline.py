import pytest
import torch

from rgbavatar_ns.bench.roofline import (
    BACKWARD_OPERATIONS_PER_PAIR,
    FORWARD_OPERATIONS_PER_PAIR,
    MachineSpeed,
    Work,
    measure_speed,
    parameter_work,
    rasterizer_work,
    roofline_figures,
    update_work,
)
from rgbavatar_ns.bench.scenes import ellipsoid_scene

SPEED = MachineSpeed(lane_operations_per_second=1e9, bytes_per_second=1e6)


def test_the_slower_of_arithmetic_and_memory_decides():
    assert Work(2_000_000_000, 1_000_000).seconds(SPEED) == pytest.approx(2.0)
    assert Work(2_000_000_000, 3_000_000).seconds(SPEED) == pytest.approx(3.0)


@pytest.mark.parametrize("factor", [2, 10])
def test_the_roofline_grows_linearly_with_the_work(factor):
    stages = ((3_000_000_000, 100_000), (0, 4_000_000))
    one = roofline_figures([Work(*stage) for stage in stages], SPEED, 2, 50_000.0, 7.0)
    larger = [Work(factor * operations, factor * moved) for operations, moved in stages]
    more = roofline_figures(larger, SPEED, 2, 50_000.0, 7.0)
    assert one["ms_per_image"] == pytest.approx(1e3 * (3 + 4) / 2)
    assert one["reached"] == pytest.approx(one["ms_per_image"] / 50_000)
    for name in ("ms_per_image", "arithmetic_ms_per_image", "traffic_ms_per_image"):
        assert more[name] == pytest.approx(factor * one[name])


def test_a_batch_of_more_images_and_pairs_is_proportionally_more_work():
    small = rasterizer_work(1000, *ellipsoid_scene(50, 16, 1), backward=True)
    large = rasterizer_work(3000, *ellipsoid_scene(50, 16, 3), backward=True)
    assert large.operations == 3 * small.operations
    assert large.moved_bytes == 3 * small.moved_bytes


def test_every_number_moves_as_often_as_it_must():
    gaussians, cameras = ellipsoid_scene(50, 16, 2, shared=True)
    inputs = 2 * 50 * (3 + 4 + 3) + 50 * (3 + 1)
    forward = rasterizer_work(7, gaussians, cameras, backward=False)
    both = rasterizer_work(7, gaussians, cameras, backward=True)
    assert forward.operations == 7 * FORWARD_OPERATIONS_PER_PAIR
    assert both.operations == 7 * (FORWARD_OPERATIONS_PER_PAIR + BACKWARD_OPERATIONS_PER_PAIR)
    assert forward.moved_bytes == 4 * (inputs + 2 * 16 * 16 * 4)
    assert both.moved_bytes == 4 * (3 * inputs + 2 * 16 * 16 * (4 + 4 + 3))
    parameters = [torch.nn.Parameter(torch.zeros(5, 2)), torch.nn.Parameter(torch.zeros(3))]
    assert parameter_work(parameters).moved_bytes == 4 * 13
    targets = torch.zeros(2, 4, 4, 4, dtype=torch.uint8)
    assert update_work(parameters, targets).moved_bytes == 6 * 4 * 13 + 2 * 4 * 4 * 4


def test_the_machine_has_a_speed():
    speed = measure_speed(matrix_side=128, copy_mib=4, seconds=0.01)
    assert 1e7 < speed.lane_operations_per_second < 1e14
    assert 1e7 < speed.bytes_per_second < 1e13
