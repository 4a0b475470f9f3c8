"""When a performer's rest is known: after enough of them was seen, or at a recording's end."""

import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.driving.live_transfer import LiveOptions, LiveTransfer
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.export import front_camera
from rgbavatar_ns.synthetic.performer.performance import perform
from tests.export.subject import avatar_of

_RATE = 25.0


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return avatar_of()


def _performance(avatar: Avatar, seed: int, count: int) -> torch.Tensor:
    names = avatar.head.arrays.expression_names
    theta = perform(avatar.layout, names, count, count // 4, _RATE, seed)
    return torch.from_numpy(theta).float()


def _transfer(avatar: Avatar, **options: float) -> LiveTransfer:
    film, camera = _performance(avatar, 7, 100), front_camera(avatar, 64, 64)
    views = camera.world_to_camera.expand(len(film), 4, 4)
    own = TrainingStatistics.of(film, torch.zeros(len(film), 1), avatar.layout, views)
    head = PerformerHead(avatar.layout, avatar.head.arrays)
    return LiveTransfer(avatar, own, head, camera, LiveOptions(smooth=False, **options))


def _frame(theta: torch.Tensor, time_s: float) -> PerformanceFrame:
    return PerformanceFrame(round(time_s * 1000), time_s, time_s, theta=theta)


def test_while_nobody_is_seen_nothing_is_learnt(avatar):
    """A face at once, then none for two seconds: the one second is counted from there."""
    glanced, stayed = (torch.zeros(avatar.layout.size) for _ in range(2))
    where = avatar.layout.slice("rotation")
    glanced[where] = torch.tensor([0.0, 0.6, 0.0])
    paused, plain = _transfer(avatar), _transfer(avatar)
    paused(_frame(glanced, 0.0))
    plain(_frame(glanced, 0.0))
    lasted = []
    for transfer, begin_s in ((paused, 2.0), (plain, 1 / _RATE)):
        count = 0
        while transfer.calibrating:
            shown = transfer(_frame(stayed, begin_s + count / _RATE))
            count += 1
        lasted.append(count)
        assert shown[where].norm() < 0.05, "of some twenty frames one was a glance"
    assert lasted[1] == _RATE
    assert lasted[0] == 14, "of the gap half a second counts: .5 + 13 / 25 is the first above 1"


@pytest.mark.parametrize("every_s", [0.3, 1.0, 60.0])
def test_slow_senders_are_met_by_ten_frames(avatar, every_s):
    transfer = _transfer(avatar)
    for k in range(10):
        assert transfer.calibrating
        transfer(_frame(torch.zeros(avatar.layout.size), k * every_s))
    assert not transfer.calibrating


def test_a_clock_that_is_set_back_ends_no_calibration_and_prevents_none(avatar):
    transfer, count = _transfer(avatar), 0
    while transfer.calibrating:
        time_s = count / _RATE + (1e6 if count < 13 else 0.0)
        transfer(_frame(torch.zeros(avatar.layout.size), time_s))
        count += 1
    assert count == pytest.approx(_RATE + 1, abs=2)


def test_a_short_recording_is_known_as_one_whose_calibration_is_as_short(avatar):
    frames = [_frame(row, k / _RATE) for k, row in enumerate(_performance(avatar, 3, 15))]
    short, as_short = _transfer(avatar), _transfer(avatar, calibrate_s=14 / _RATE)
    for transfer in (short, as_short):
        for frame in frames:
            assert transfer.calibrating
            transfer.learn(frame)
    short.conclude()
    assert not short.calibrating
    assert not as_short.calibrating
    for frame in frames:
        assert torch.equal(short(frame), as_short(frame))


def test_a_calibration_that_learnt_nothing_goes_on(avatar):
    transfer = _transfer(avatar)
    transfer.conclude()
    assert transfer.calibrating
