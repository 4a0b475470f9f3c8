import math
import socket
import sys
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.driving.sources.vmc import VmcSource
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arkit import ARKIT_NAMES

osc = pytest.importorskip("pythonosc.osc_message_builder", reason="python-osc is not installed")
osc_bundle = pytest.importorskip("pythonosc.osc_bundle_builder")


def _message(address, *values):
    builder = osc.OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build().dgram


@pytest.fixture(scope="module")
def source():
    listening = VmcSource("127.0.0.1:0")
    yield listening
    listening.close()


def _send(source, *packets):
    host, port = source.address.split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for packet in packets:
            sender.sendto(packet, (host, int(port)))
    time.sleep(0.1)


def _value(frame, name):
    return float(frame.coefficients[ARKIT_NAMES.index(name)])


def test_names_of_vrm_count_until_arkits_come(source):
    _send(
        source,
        _message("/VMC/Ext/Blend/Val", "Blink", 1.0),
        _message("/VMC/Ext/Blend/Val", "A", 0.5),
        _message("/VMC/Ext/Blend/Apply"),
    )
    frame = source.next(1.0)
    assert _value(frame, "eyeBlinkLeft") == _value(frame, "eyeBlinkRight") == 1.0
    assert _value(frame, "jawOpen") == pytest.approx(0.35)
    _send(
        source,
        _message("/VMC/Ext/Blend/Val", "JawOpen", 0.25),
        _message("/VMC/Ext/Blend/Apply"),
    )
    frame = source.next(1.0)
    assert _value(frame, "jawOpen") == 0.25
    assert _value(frame, "eyeBlinkLeft") == 0.0


def test_nothing_is_shown_before_it_is_applied(source):
    _send(source, _message("/VMC/Ext/Blend/Val", "jawOpen", 0.5))
    assert source.next(0.05) is None
    _send(source, _message("/VMC/Ext/Blend/Apply"))
    assert _value(source.next(1.0), "jawOpen") == 0.5


def test_what_is_told_after_a_frame_belongs_to_the_next(source):
    """However many packets wait: a frame is what was told when it was applied."""
    half = math.sin(math.radians(15))
    begun = [
        _message("/VMC/Ext/Blend/Val", "jawOpen", 0.75),
        _message("/VMC/Ext/Bone/Pos", "Head", 0.0, 1.5, 0.0, half, 0.0, 0.0, half),
    ]
    applied = _message("/VMC/Ext/Blend/Apply")
    _send(source, _message("/VMC/Ext/Blend/Val", "jawOpen", 0.25), applied)
    before = source.next(1.0)
    _send(source, applied, *begun)
    frame = source.next(1.0)
    assert _value(frame, "jawOpen") == 0.25
    assert frame.head_rotation is before.head_rotation
    _send(source, applied)
    frame = source.next(1.0)
    assert _value(frame, "jawOpen") == 0.75
    assert frame.head_rotation.tolist() == pytest.approx([math.radians(90), 0, 0], abs=1e-5)


def test_one_packet_may_end_a_frame_and_begin_the_next(source):
    bundle = osc_bundle.OscBundleBuilder(osc_bundle.IMMEDIATELY)
    for told in (("Val", "jawOpen", 0.25), ("Apply",), ("Val", "jawOpen", 0.75)):
        message = osc.OscMessageBuilder(f"/VMC/Ext/Blend/{told[0]}")
        for value in told[1:]:
            message.add_arg(value)
        bundle.add_content(message.build())
    _send(source, bundle.build().dgram)
    assert _value(source.next(1.0), "jawOpen") == 0.25


def test_the_head_turns_to_the_same_side_as_in_unity(source):
    """About Unity's y by +30 degrees x goes away from the viewer: one turns to the right."""
    half = math.radians(15)
    turn = (0.0, math.sin(half), 0.0, math.cos(half))
    _send(
        source,
        _message("/VMC/Ext/Bone/Pos", "Head", 0.0, 1.5, 0.0, *turn),
        _message("/VMC/Ext/Blend/Apply"),
    )
    assert source.next(1.0).head_rotation.tolist() == pytest.approx(
        [0, -math.radians(30), 0], abs=1e-5
    )


def test_what_is_no_number_or_unknown_is_counted(source):
    before = source.counts.copy()
    _send(
        source,
        _message("/VMC/Ext/Blend/Val", "jawOpen", math.nan),
        _message("/VMC/Ext/Blend/Val", "jawOpen", "wide"),
        _message("/VMC/Ext/Blend/Val", "tail", 1.0),
        _message("/VMC/Ext/Blend/Val", "jawOpen", 3.0),
        _message("/VMC/Ext/Bone/Pos", "Head", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        b"garbage",
        _message("/VMC/Ext/Blend/Apply"),
    )
    frame = source.next(1.0)
    assert _value(frame, "jawOpen") == 1.0
    new = source.counts - before
    assert new["not numbers"] == 3
    assert new["unknown blend shapes"] == 1
    assert new["values beyond 0..1"] == 1
    assert new["unreadable"] == 1


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200), st.sampled_from([b"", b"/VMC/Ext/Blend/Val\0\0", b"#bundle\0"]))
def test_no_bytes_end_it(source, content, begin):
    source._read(begin + content)


def test_a_missing_library_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "pythonosc.osc_packet", None)
    with pytest.raises(UserError, match="pip install python-osc"):
        VmcSource("127.0.0.1:0")
