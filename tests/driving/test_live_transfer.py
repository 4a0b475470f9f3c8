"""What a live performance makes of the avatar: followed, calibrated, held, and never broken."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.driving.live_transfer import LiveOptions, LiveTransfer
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.driving.sources.live_link_face import parse_packet
from rgbavatar_ns.export import front_camera
from rgbavatar_ns.head import EMBEDDED_BUST, HeadArrays, HeadModel, turn_seen
from rgbavatar_ns.head.arkit import ARKIT_NAMES, arkit_map
from rgbavatar_ns.head.landmarks import facemesh_landmarks
from rgbavatar_ns.head.lips import LipGap
from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from rgbavatar_ns.synthetic.performer.performance import perform, with_tracker_noise
from rgbavatar_ns.threads import using_threads
from tests.export.subject import avatar_of

from .packets import packet

_RATE = 25.0
_HEAD = HeadArrays.embedded()


def _performance(seed: int, seconds: float = 12.0, noise: float = 0.0) -> torch.Tensor:
    layout, names = HeadModel(_HEAD).layout, _HEAD.expression_names
    count = int(seconds * _RATE)
    theta = perform(layout, names, count, count // 4, _RATE, seed)
    return torch.from_numpy(with_tracker_noise(theta, layout, names, noise, seed)).float()


def _own(avatar: Avatar, theta: torch.Tensor) -> TrainingStatistics:
    cameras = front_camera(avatar, 64, 64).world_to_camera.expand(len(theta), 4, 4)
    return TrainingStatistics.of(theta, torch.zeros(len(theta), 1), avatar.layout, cameras)


def _driven(
    performed: torch.Tensor,
    avatar: Avatar,
    own: TrainingStatistics,
    options: LiveOptions | None = None,
) -> torch.Tensor:
    head = PerformerHead(HeadModel(_HEAD).layout, _HEAD)
    transfer = LiveTransfer(avatar, own, head, front_camera(avatar, 64, 64), options)
    return torch.stack(
        [
            transfer(PerformanceFrame(k, k / _RATE, k / _RATE, theta=theta))
            for k, theta in enumerate(performed)
        ]
    )


def _correlation(first: torch.Tensor, second: torch.Tensor) -> float:
    return float(np.corrcoef(first.numpy(), second.numpy())[0, 1])


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return avatar_of()


@pytest.fixture(scope="module")
def own(avatar) -> TrainingStatistics:
    return _own(avatar, _performance(7))


def _gap(theta: torch.Tensor) -> torch.Tensor:
    lips = LipGap.of(HeadModel(_HEAD), torch.zeros(_HEAD.num_identity))
    assert lips is not None
    return lips(theta)


@pytest.mark.parametrize("seed", [1, 2])
def test_mouth_lids_and_turns_follow_another_person(avatar, own, seed):
    performed = _performance(seed, noise=1.0)
    driven = _driven(performed, avatar, own)
    assert _correlation(_gap(driven), _gap(performed)) > 0.95
    lids = [_HEAD.expression_names.index(f"eyeBlink{side}") for side in ("Left", "Right")]
    for place in lids:
        assert _correlation(driven[:, place], performed[:, place]) > 0.95
    camera = front_camera(avatar, 64, 64).world_to_camera
    seen = [turn_seen(theta, camera, avatar.layout)[:, :2] for theta in (driven, performed)]
    for axis in range(2):
        assert _correlation(seen[0][:, axis], seen[1][:, axis]) > 0.95


@pytest.mark.parametrize("offset", [0.0, 0.25])
def test_a_mouth_that_is_open_while_it_is_met_closes_afterwards(avatar, own, offset):
    """In the first second the performer speaks on: what rests is learnt, not what is there."""
    performed = _performance(3)
    jaw = avatar.layout.slice("jaw").start
    performed[:30, jaw] = 0.15
    smile = _HEAD.expression_names.index("mouthSmileLeft")
    performed[:, smile] += offset  # a tracker's bias
    driven = _driven(performed, avatar, own)
    assert _correlation(_gap(driven), _gap(performed)) > 0.95
    quiet = performed[100:, jaw] < 0.01
    assert _gap(driven[100:][quiet]).median() < _gap(own.theta_neutral[None])[0] + 0.002


def test_a_constant_bias_of_the_tracker_is_no_expression(avatar, own):
    """Brows that a tracker sees lowered all the time stay at rest."""
    performed, brow = _performance(4), _HEAD.expression_names.index("browDownLeft")
    biased = performed.clone()
    biased[:, brow] += 0.3
    plain, driven = (_driven(theta, avatar, own) for theta in (performed, biased))
    assert (driven - plain)[50:, brow].abs().max() < 0.06


def test_expressions_and_turns_stay_where_the_avatar_holds(avatar, own):
    performed = 3.0 * _performance(5)
    free = _driven(performed, avatar, own, LiveOptions(keep_range=False, smooth=False))
    held = _driven(performed, avatar, own, LiveOptions(smooth=False))
    low, high = own.film_range()
    room = 0.5 * (high - low) + 1e-4
    expressive = own.expressive
    assert ((held <= high + room) & (held >= low - room))[:, expressive].all()
    assert (free > high + room)[:, expressive].any(), "else nothing was held"
    camera = front_camera(avatar, 64, 64).world_to_camera
    turned = turn_seen(held, camera, avatar.layout)[:, :2]
    leftmost, rightmost = own.filmed_turns()
    assert (turned <= rightmost + 21).all()
    assert (turned >= leftmost - 21).all()
    assert (turn_seen(free, camera, avatar.layout)[:, 0].abs() > rightmost[0] + 25).any()


def test_numbers_are_few_and_wake_no_other_threads(avatar, own, monkeypatch):
    used, at_lips = [], LipGap.__call__

    def look(lips: LipGap, theta: torch.Tensor) -> torch.Tensor:
        used.append(torch.get_num_threads())
        return at_lips(lips, theta)

    with using_threads(3):
        head = PerformerHead(HeadModel(_HEAD).layout, _HEAD)
        transfer = LiveTransfer(avatar, own, head, front_camera(avatar, 64, 64))
        monkeypatch.setattr(LipGap, "__call__", look)
        transfer(PerformanceFrame(0, 0.0, 0.0, theta=own.theta_mean))
        assert torch.get_num_threads() == 3
    assert used == [1]


def test_at_rest_an_avatar_is_its_own_neutral(avatar, own):
    rest = torch.zeros(60, avatar.layout.size)
    driven = _driven(rest, avatar, own)
    wanted = torch.where(own.expressive, own.theta_neutral, own.theta_mean)
    jaw = avatar.layout.slice("jaw").start
    expected = wanted.clone()
    expected[jaw] = driven[-1, jaw]  # the lips have the last word about the jaw
    torch.testing.assert_close(driven[-1], expected, atol=1e-3, rtol=0)
    assert abs(float(driven[-1, jaw] - wanted[jaw])) < 0.05


def test_calibrating_again_takes_the_new_rest(avatar, own):
    head = PerformerHead(HeadModel(_HEAD).layout, _HEAD)
    transfer = LiveTransfer(avatar, own, head, front_camera(avatar, 64, 64))
    turn = torch.zeros(avatar.layout.size)
    turned = turn.clone()
    where = avatar.layout.slice("rotation")
    turned[where] = torch.tensor([0.0, 0.15, 0.0])

    def show(theta: torch.Tensor, first: int, count: int) -> torch.Tensor:
        for k in range(first, first + count):
            shown = transfer(PerformanceFrame(k, k / _RATE, k / _RATE, theta=theta))
        return shown

    rest = show(turn, 0, 40)
    assert not transfer.calibrating
    away = show(turned, 40, 40)
    assert (away - rest)[where].norm() > 0.1
    transfer.calibrate()
    assert transfer.calibrating
    still_away = show(turned, 80, 5)
    torch.testing.assert_close(still_away[where], away[where], atol=5e-3, rtol=0)
    again = show(turned, 85, 60)
    assert not transfer.calibrating
    torch.testing.assert_close(again[where], rest[where], atol=5e-3, rtol=0)


class _Mouth:
    """A performer who keeps each face for a while; how far the avatar's lips are then apart."""

    def __init__(self, avatar: Avatar, own: TrainingStatistics) -> None:
        head = PerformerHead(HeadModel(_HEAD).layout, _HEAD)
        self.transfer = LiveTransfer(avatar, own, head, front_camera(avatar, 64, 64))
        self._jaw, self._size = avatar.layout.slice("jaw").start, avatar.layout.size
        self._count = 0

    def show(self, seconds: float, jaw: float = 0.0, **expressions: float) -> float:
        theta = torch.zeros(self._size)
        theta[self._jaw] = jaw
        for name, weight in expressions.items():
            theta[_HEAD.expression_names.index(name)] = weight
        driven = theta
        for _ in range(int(seconds * _RATE)):
            time_s = self._count / _RATE
            driven = self.transfer(PerformanceFrame(self._count, time_s, time_s, theta=theta))
            self._count += 1
        return float(_gap(driven[None])[0])


def test_lips_that_were_pressed_once_close_again_by_themselves(avatar, own):
    mouth = _Mouth(avatar, own)
    before = mouth.show(10.0)
    mouth.show(1.0, mouthClose=0.4)
    assert mouth.show(0.5) > before + 0.002, "else there was nothing to forget"
    assert mouth.show(30.0) == pytest.approx(before, abs=5e-4)


def test_calibrating_again_forgets_that_lips_were_pressed(avatar, own):
    mouth = _Mouth(avatar, own)
    before = mouth.show(2.0)
    mouth.show(1.0, mouthClose=0.4)
    mouth.transfer.calibrate()
    assert mouth.show(2.0) == pytest.approx(before, abs=5e-4)


def test_lips_that_are_measured_apart_while_closed_are_closed(avatar, own):
    """A tracker that sees the jaw a little open at rest: that is the performer's rest."""
    closed = _Mouth(avatar, own).show(3.0)
    mouth = _Mouth(avatar, own)
    assert mouth.show(3.0, jaw=0.04) == pytest.approx(closed, abs=5e-4)


def test_a_mouth_that_is_kept_open_stays_open(avatar, own):
    mouth = _Mouth(avatar, own)
    mouth.show(3.0)
    opened = mouth.show(1.0, jaw=0.15)
    assert mouth.show(60.0, jaw=0.15) == pytest.approx(opened, abs=5e-4)


def test_an_arkit_stream_of_the_demo_performance_comes_back(avatar):
    """Sent as Live Link Face sends, driving the subject itself: each expression's correlation."""
    performed = _performance(7)
    own = _own(avatar, performed)
    known = arkit_map(_HEAD)
    coefficients = known.coefficients(performed)
    transfer = LiveTransfer(avatar, own, None, front_camera(avatar, 64, 64))
    driven = []
    for k, row in enumerate(coefficients):
        read = parse_packet(packet(row.clamp(0, 1).tolist(), frame=k))
        frame = PerformanceFrame(k, k / _RATE, k / _RATE, coefficients=read.coefficients)
        driven.append(transfer(frame))
    result = torch.stack(driven)
    told = 0
    for place, name in enumerate(_HEAD.expression_names):
        if performed[:, place].std() < 0.02:
            continue
        told += 1
        assert _correlation(result[:, place], performed[:, place]) > 0.98, name
    assert told > 20
    assert _correlation(_gap(result), _gap(performed)) > 0.98
    for eye in ("left_eye", "right_eye"):
        for axis in range(2):
            place = avatar.layout.slice(eye).start + axis
            assert _correlation(result[:, place], performed[:, place]) > 0.95
    still = avatar.layout.slice("translation")
    assert torch.equal(result[:, still], own.theta_mean[still].expand(len(result), 3))


def test_a_phone_turns_a_head_upon_its_shoulders():
    avatar = avatar_of(arrays=HeadArrays.embedded(EMBEDDED_BUST))
    theta = torch.zeros(30, avatar.layout.size)
    theta[:, : len(ARKIT_NAMES)] = 0.5 * torch.rand(30, len(ARKIT_NAMES))
    theta[:, avatar.layout.slice("neck")] = 0.3 * (torch.rand(30, 3) - 0.5)
    own = _own(avatar, theta)
    transfer = LiveTransfer(avatar, own, None, front_camera(avatar, 64, 64))
    nothing, turn = torch.zeros(len(ARKIT_NAMES)), torch.tensor([0.0, 0.2, 0.0])
    for k in range(60):
        said = turn if k > 40 else torch.zeros(3)
        driven = transfer(
            PerformanceFrame(k, k / _RATE, k / _RATE, coefficients=nothing, head_rotation=said)
        )
    neck, root = avatar.layout.slice("neck"), avatar.layout.slice("rotation")
    assert driven[neck][1] - own.theta_mean[neck][1] > 0.1
    assert torch.equal(driven[root], own.theta_mean[root])


def test_what_is_learnt_ahead_holds_from_the_first_frame(avatar, own):
    """A recording's first second is known before it is shown: nothing drifts while it is learnt."""
    head = PerformerHead(HeadModel(_HEAD).layout, _HEAD)
    frames = [
        PerformanceFrame(k, k / _RATE, k / _RATE, theta=theta)
        for k, theta in enumerate(_performance(9, 4.0))
    ]
    options = LiveOptions(smooth=False)
    ahead, later = (
        LiveTransfer(avatar, own, head, front_camera(avatar, 64, 64), options) for _ in range(2)
    )
    for frame in frames[:26]:
        assert ahead.calibrating
        ahead.learn(frame)
    assert not ahead.calibrating
    for frame in frames[:60]:
        later(frame)
    turn = avatar.layout.slice("neck")
    once, again = ahead(frames[0]), later(replace(frames[0], time_s=9.0))
    torch.testing.assert_close(once[turn], again[turn], atol=1e-5, rtol=0)


def test_numbers_can_be_taken_as_they_are(avatar, own):
    performed = _performance(6)
    options = LiveOptions(calibrate_s=0.0, pose="absolute", keep_range=False, smooth=False)
    torch.testing.assert_close(
        _driven(performed, avatar, own, options), performed, atol=1e-5, rtol=0
    )


@pytest.mark.parametrize(("moving", "share"), [(True, 0.85), (False, 0.8)])
def test_jitter_is_filtered_and_hardly_delays(avatar, own, moving, share):
    calm = _performance(8, 8.0) * moving
    noisy = calm + 0.01 * torch.randn(calm.shape, generator=torch.Generator().manual_seed(0))

    def added(smooth: bool) -> torch.Tensor:
        """What the noise adds to expressions, after the calibration."""
        options = LiveOptions(smooth=smooth, keep_range=False)
        both = [_driven(theta, avatar, own, options) for theta in (noisy, calm)]
        return (both[0] - both[1])[50:, own.expressive].std()

    assert added(True) < share * added(False)
    if moving:
        gaps = [_gap(_driven(calm, avatar, own, LiveOptions(smooth=on))) for on in (True, False)]
        assert _correlation(gaps[0], gaps[1]) > 0.99


def test_after_a_gap_nothing_is_dragged_along(avatar, own):
    head = PerformerHead(HeadModel(_HEAD).layout, _HEAD)
    transfer = LiveTransfer(avatar, own, head, front_camera(avatar, 64, 64))
    theta = torch.zeros(avatar.layout.size)
    for k in range(40):
        transfer(PerformanceFrame(k, k / _RATE, k / _RATE, theta=theta))
    blink = _HEAD.expression_names.index("eyeBlinkLeft")
    closed = theta.clone()
    closed[blink] = 0.8
    late = transfer(PerformanceFrame(41, 9.0, 9.0, theta=closed))
    assert late[blink] > 0.75


def test_own_statistics_without_a_film_are_enough(avatar, own):
    few = replace(own, theta_min=own.theta_mean, theta_max=own.theta_mean)
    driven = _driven(_performance(1, 2.0), avatar, few)
    assert torch.isfinite(driven).all()


def _lids(head: HeadModel, theta: torch.Tensor) -> torch.Tensor:
    """How far apart the left eye's lids are along the face's height."""
    still = theta.clone()
    for name in ("rotation", "neck", "translation"):
        still[:, head.layout.slice(name)] = 0
    marks, at_rest = facemesh_landmarks(), _HEAD.v_template
    rows = [int(np.flatnonzero(marks.facemesh_index == index)[0]) for index in (386, 374)]
    corners = at_rest[_HEAD.faces[marks.triangle[rows]]]
    points = np.einsum("pk,pkx->px", marks.barycentric[rows], corners)
    # The made-up FLAME is the embedded head cut: the same vertices under other numbers.
    nearest = np.linalg.norm(head.arrays.v_template[:, None] - points, axis=2).argmin(0)
    upper, lower = head(still)[:, nearest.tolist(), 1].unbind(1)
    return upper - lower


def test_a_person_drives_flame(flame_2020):
    """A performance of the embedded head moves an avatar of FLAME's: mouth, blinks and turns."""
    avatar = avatar_of(arrays=flame_2020)
    performed = _performance(2, noise=0.5)
    known = arkit_map(_HEAD)
    film = avatar.arkit.theta(known.coefficients(_performance(7)), known.head_rotation(performed))
    driven = _driven(performed, avatar, _own(avatar, film))
    flame = LipGap.of(avatar.head, avatar.identity)
    assert flame is not None
    assert _correlation(flame(driven), _gap(performed)) > 0.95
    turns = axis_angle_to_matrix(driven[:, avatar.layout.slice("rotation")])
    wanted = axis_angle_to_matrix(known.head_rotation(performed))
    for axis in range(2):
        assert _correlation(turns[:, axis, 2], wanted[:, axis, 2]) > 0.95
    assert _correlation(_lids(avatar.head, driven), _lids(HeadModel(_HEAD), performed)) > 0.95
