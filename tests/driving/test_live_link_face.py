import math
import socket
import threading
import time

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.driving.sources.live_link_face import (
    LiveLinkFaceSource,
    head_rotation,
    parse_packet,
)
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arkit import ARKIT_NAMES
from rgbavatar_ns.head.rotations import axis_angle_to_matrix

from .packets import packet

_ROW = [k / 100 for k in range(52)]


def test_a_packet_is_read_by_its_bytes():
    read = parse_packet(packet(_ROW, (0.1, -0.2, 0.3), frame=90))
    assert (read.device, read.subject, read.frame) == ("A1B2", "phone", 90)
    assert read.time_s == pytest.approx(1.5)
    torch.testing.assert_close(read.coefficients, torch.tensor(_ROW))
    assert read.angles == pytest.approx((0.1, -0.2, 0.3))
    jaw = ARKIT_NAMES.index("jawOpen")
    assert jaw == 17, "Unreal's order"
    assert read.coefficients[jaw] == pytest.approx(0.17)


def test_what_is_beyond_0_to_1_is_held_and_counted():
    read = parse_packet(packet([-0.5, 1.5, *_ROW[2:]]))
    assert read.coefficients[:2].tolist() == [0.0, 1.0]
    assert read.out_of_range == 2


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "begins with nothing"),
        (packet(_ROW, version=5), "begins with 5"),
        (packet(_ROW)[:100], "of 100 bytes cannot be read"),
        (packet(_ROW, count=60), "60 numbers, not 61"),
        (packet([math.nan, *_ROW[1:]]), "NaN"),
        (packet([math.inf, *_ROW[1:]]), "NaN"),
        (b"\x06\x7f\xff\xff\xff" + bytes(300), "text of 2147483647 bytes"),
        (b"\x06\xff\xff\xff\xff" + bytes(300), "text of -1 bytes"),
    ],
)
def test_other_packets_are_refused_with_the_reason(content, told):
    with pytest.raises(UserError, match=told):
        parse_packet(content)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=400), st.booleans())
def test_no_bytes_end_in_anything_but_a_reading_or_a_user_error(content, begun):
    try:
        read = parse_packet(b"\x06" + content if begun else content)
    except UserError:
        return
    assert torch.isfinite(read.coefficients).all()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 400))
def test_a_damaged_packet_never_gives_what_is_no_number(seed, at):
    damaged = bytearray(packet(_ROW))
    rng = np.random.default_rng(seed)
    damaged[at % len(damaged)] = int(rng.integers(256))
    try:
        read = parse_packet(bytes(damaged))
    except UserError:
        return
    assert torch.isfinite(read.coefficients).all()
    assert 0 <= read.coefficients.min() <= read.coefficients.max() <= 1
    assert all(math.isfinite(angle) for angle in read.angles)
    assert math.isfinite(read.time_s)


@pytest.mark.parametrize(
    ("angles", "of", "to"),
    [
        ((0.3, 0.0, 0.0), [0.0, 0.0, 1.0], [-1, None, None]),  # to the right: the face to -x
        ((0.0, 0.3, 0.0), [0.0, 0.0, 1.0], [None, 1, None]),  # up: the face to +y
        ((0.0, 0.0, 0.3), [0.0, 1.0, 0.0], [-1, None, None]),  # to the right shoulder
    ],
)
def test_the_heads_angles_turn_as_unreals_do(angles, of, to):
    turned = axis_angle_to_matrix(head_rotation(*angles)) @ torch.tensor(of)
    for value, sign in zip(turned.tolist(), to):
        if sign is not None:
            assert value * sign == pytest.approx(math.sin(0.3), abs=1e-5)


@pytest.fixture
def source():
    listening = LiveLinkFaceSource("127.0.0.1:0")
    yield listening
    listening.close()


def _sender(source: LiveLinkFaceSource) -> socket.socket:
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    host, port = source.address.split(":")
    sender.connect((host, int(port)))
    return sender


def test_packets_come_in_with_the_newest_first(source):
    with _sender(source) as sender:
        for k in range(5):
            sender.send(packet([k / 10] * 52, frame=k))
        time.sleep(0.3)
        frame = source.next(1.0)
        assert frame.coefficients[0] == pytest.approx(0.4)
        assert source.counts["skipped"] == 4
        assert source.next(0.05) is None


def test_garbage_other_versions_and_other_devices_are_counted_and_left_out(source):
    with _sender(source) as sender:
        sender.send(packet(_ROW))
        assert source.next(2.0) is not None
        sender.send(b"\x06garbage")
        sender.send(packet(_ROW, version=9))
        sender.send(packet(_ROW, device="other"))
        time.sleep(0.3)
        assert source.next(0.1) is None
    told = {name: source.counts[name] for name in ("unreadable", "another version")}
    assert told == {"unreadable": 1, "another version": 1}
    assert source.counts["another device"] == 1


def test_ten_thousand_packets_a_second_leave_the_newest_and_no_queue(source):
    stop = threading.Event()

    def flood():
        with _sender(source) as sender:
            k = 0
            while not stop.is_set():
                sender.send(packet([(k % 100) / 100] * 52, frame=k))
                k += 1
                if k % 100 == 0:
                    time.sleep(0.01)

    flooding = threading.Thread(target=flood)
    flooding.start()
    try:
        late = []
        for _ in range(30):
            frame = source.next(1.0)
            late.append(time.monotonic() - frame.captured_s)
    finally:
        stop.set()
        flooding.join()
    assert np.median(late) < 0.1


def test_other_machines_reach_it_only_when_asked_for():
    with pytest.raises(UserError, match=r"Other machines could send.*allow-remote"):
        LiveLinkFaceSource("0.0.0.0:0")
    opened = LiveLinkFaceSource("0.0.0.0:0", allow_remote=True)
    opened.close()


def test_a_taken_port_is_told():
    first = LiveLinkFaceSource("127.0.0.1:0")
    try:
        with pytest.raises(UserError, match=r"Nothing can be received at.*--listen"):
            LiveLinkFaceSource(first.address)
    finally:
        first.close()


@pytest.mark.parametrize("sent", [30.0, -170.0, 400.0])
def test_a_sender_of_degrees_turns_the_head_by_degrees(sent):
    source = LiveLinkFaceSource("127.0.0.1:0", angle_gain=[math.radians(1)] * 3)
    host, port = source.address.rsplit(":", 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(packet(_ROW, (sent, 0.0, 0.0)), (host, int(port)))
        frame = source.next(2.0)
    source.close()
    turned = axis_angle_to_matrix(frame.head_rotation)
    wanted = axis_angle_to_matrix(head_rotation(math.radians(sent), 0.0, 0.0))
    torch.testing.assert_close(turned, wanted, atol=1e-5, rtol=0)
