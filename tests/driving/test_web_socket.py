import json
import socket
import time

import pytest
import torch
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from rgbavatar_ns.driving.source import PerformerHead
from rgbavatar_ns.driving.sources.web_socket import WebSocketSource, arkit_trouble
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays, HeadModel
from rgbavatar_ns.head.arkit import ARKIT_NAMES
from tests.avatar.small_head import small_head_arrays
from tests.export.subject import avatar_of

_HEAD = HeadModel.embedded()


@pytest.fixture
def source():
    listening = WebSocketSource(PerformerHead(_HEAD.layout, HeadArrays.embedded()), "127.0.0.1:0")
    yield listening
    listening.close()


def _say(client, **message):
    client.send(json.dumps(message))


def test_coefficients_and_pose_come_in(source):
    with connect(f"ws://{source.address}") as client:
        _say(client, type="hello", format="rgbavatar-drive", version=1)
        pose = {"rotation": [0.1, 0.2, 0.3]}
        _say(client, type="arkit", coefficients={"jawOpen": 0.4}, pose=pose)
        frame = source.next(2.0)
        _say(client, type="arkit", pose={"translation": [0.1, 0, 0]})
        moved = source.next(2.0)
    assert frame.coefficients[ARKIT_NAMES.index("jawOpen")] == pytest.approx(0.4)
    torch.testing.assert_close(frame.head_rotation, torch.tensor([0.1, 0.2, 0.3]))
    assert moved.head_rotation is None


def test_the_avatars_own_theta_comes_in(source):
    theta = torch.linspace(-0.1, 0.1, _HEAD.layout.size)
    with connect(f"ws://{source.address}") as client:
        _say(client, type="theta", theta=theta.tolist())
        torch.testing.assert_close(source.next(2.0).theta, theta)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("garbage", "cannot be read"),
        ("[1]", "no object with a type"),
        ('{"type": "dance"}', "no message of type dance"),
        ('{"type": "hello", "format": "rgbavatar-drive", "version": 2}', "drive 2, not"),
        ('{"type": "arkit", "coefficients": {"jawOpen": "wide"}}', "no numbers by name"),
        ('{"type": "arkit", "coefficients": {"jawOpne": 0.1}}', "Did you mean jawOpen"),
        ('{"type": "arkit", "coefficients": {"jawOpen": NaN}}', "no numbers by name"),
        ('{"type": "arkit", "pose": {"rotation": [1, 2]}}', "not 3 numbers, but 2"),
        ('{"type": "arkit", "pose": {"rotation": [90, 0, 0]}}', "longer than two turns"),
        ('{"type": "arkit", "pose": 3}', "pose"),
        (
            '{"type": "arkit", "coefficients": {"jawOpen": 1' + "0" * 400 + "}}",
            "no numbers by name",
        ),
        ('{"type": "theta", "theta": [1, 2]}', "numbers, but 2 values"),
        ('{"type": "theta", "theta": [' + ",".join(["1e30"] * 70) + "]}", "No head does this"),
    ],
)
def test_what_cannot_be_used_is_answered_with_the_reason(source, text, told):
    with connect(f"ws://{source.address}") as client:
        client.send(text)
        answer = json.loads(client.recv(timeout=2.0))
        assert answer["type"] == "error"
        assert told in answer["text"]
        # The sender is still heard.
        _say(client, type="arkit", coefficients={"jawOpen": 2})
        frame = source.next(2.0)
    assert frame.coefficients.max() == 1.0
    assert source.counts["unreadable"] == 1
    assert source.counts["values beyond 0..1"] == 1


def test_an_avatar_that_arkit_cannot_move_follows_theta_and_the_sender_is_told():
    avatar = avatar_of(arrays=small_head_arrays())
    trouble = arkit_trouble(avatar)
    assert trouble is not None
    assert arkit_trouble(avatar_of()) is None
    own = PerformerHead(avatar.layout, avatar.head.arrays)
    source = WebSocketSource(own, "127.0.0.1:0", without_arkit=trouble)
    assert '"arkit"' not in source.waits_for
    try:
        with connect(f"ws://{source.address}") as client:
            _say(client, type="arkit", coefficients={"jawOpen": 0.4})
            answer = json.loads(client.recv(timeout=2.0))
            assert f'"arkit" cannot move this avatar: {trouble.cause}' in answer["text"]
            theta = torch.linspace(-0.1, 0.1, avatar.layout.size)
            _say(client, type="theta", theta=theta.tolist())
            frame = source.next(2.0)
    finally:
        source.close()
    assert frame.coefficients is None
    torch.testing.assert_close(frame.theta, theta)
    assert source.counts["unreadable"] == 1


def test_the_newest_message_counts_and_the_last_who_came(source):
    with connect(f"ws://{source.address}") as first:
        _say(first, type="arkit", coefficients={"jawOpen": 0.1})
        assert source.next(2.0) is not None
        with connect(f"ws://{source.address}") as second:
            for k in range(5):
                _say(second, type="arkit", coefficients={"jawOpen": k / 10})
            time.sleep(0.2)
            frame = source.next(1.0)
            assert frame.coefficients.max() == pytest.approx(0.4)
            _say(first, type="arkit", coefficients={"jawOpen": 0.9})
            assert source.next(0.2) is None
    assert source.counts["another sender"] == 1
    assert source.counts["skipped"] == 4


def test_pages_of_this_machine_may_speak_and_others_may_not(source):
    for origin in ("http://localhost:3000", "http://127.0.0.1:8000"):
        with connect(f"ws://{source.address}", origin=origin) as client:
            _say(client, type="arkit", coefficients={})
            assert source.next(2.0) is not None
    for origin in ("https://example.com", "http://localhost.example.com", "http://127.0.0.1.evil"):
        with pytest.raises(InvalidStatus), connect(f"ws://{source.address}", origin=origin):
            pass


def test_a_page_without_an_origin_speaks_by_the_key_alone(source):
    """A page from the disk has none, and so has a sandboxed frame of any web site."""
    with connect(f"ws://{source.keyed_address}", origin="null") as client:
        _say(client, type="arkit", coefficients={})
        assert source.next(2.0) is not None
    for address in (source.address, f"{source.address}/", f"{source.keyed_address[:-1]}.", "é"):
        url = f"ws://{source.address}/{address}" if address == "é" else f"ws://{address}"
        with pytest.raises(InvalidStatus, match="403"), connect(url, origin="null"):
            pass
    with (
        pytest.raises(InvalidStatus),
        connect(f"ws://{source.keyed_address}", origin="https://a.b"),
    ):
        pass


def test_the_key_is_another_each_time(source):
    own = PerformerHead(_HEAD.layout, HeadArrays.embedded())
    other = WebSocketSource(own, "127.0.0.1:0")
    other.close()
    assert source.keyed_address.split("/")[1] != other.keyed_address.split("/")[1]


def test_pages_that_show_what_is_waited_for_learn_no_key(source):
    key = source.keyed_address.split("/")[1]
    assert source.address in source.waits_for
    assert key not in source.waits_for


def test_other_machines_reach_it_only_when_asked_for():
    own = PerformerHead(_HEAD.layout, HeadArrays.embedded())
    with pytest.raises(UserError, match="Other machines could reach"):
        WebSocketSource(own, "0.0.0.0:0")


def test_who_comes_and_goes_leaves_the_one_who_stays(source):
    with connect(f"ws://{source.address}") as first:
        _say(first, type="arkit", coefficients={"jawOpen": 0.1})
        assert source.next(2.0) is not None
        with connect(f"ws://{source.address}") as second:
            _say(second, type="arkit", coefficients={"jawOpen": 0.2})
            assert source.next(2.0) is not None
        frame, until_s = None, time.monotonic() + 5
        while frame is None and time.monotonic() < until_s:
            _say(first, type="arkit", coefficients={"jawOpen": 0.3})
            frame = source.next(0.2)
    assert frame is not None
    assert frame.coefficients.max() == pytest.approx(0.3)


def test_a_name_that_was_pointed_at_this_machine_is_refused(source):
    host, port = source.address.rsplit(":", 1)
    for name, answer in (("evil.example", b"421"), ("localhost", b"404"), ("[::1]", b"404")):
        with socket.create_connection((host, int(port)), 5) as asking:
            asking.sendall(f"GET / HTTP/1.1\r\nHost: {name}:{port}\r\n\r\n".encode())
            assert asking.recv(100).split()[1] == answer
