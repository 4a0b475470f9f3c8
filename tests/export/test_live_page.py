"""What pages are told, without a browser."""

import contextlib
import json
import socket
import threading
import time
import urllib.error
import urllib.request

import pytest
import torch
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from rgbavatar_ns.driving.live_drive import DrivenFrame
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.live_page import PageOutput
from rgbavatar_ns.head import HeadModel

_LAYOUT = HeadModel.embedded().layout


@pytest.fixture
def output():
    asked = threading.Event()
    shown = PageOutput(_LAYOUT, "127.0.0.1:0", page=lambda: b"<html>it", calibrate=asked.set)
    shown.asked = asked  # type: ignore[attr-defined]
    yield shown
    shown.close()


def _frame(index, value=0.0):
    theta = torch.full((_LAYOUT.size,), value)
    return DrivenFrame(index, theta, time.monotonic(), index / 25)


def _until(condition):
    for _ in range(200):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("it has not come to pass")


def test_a_page_is_greeted_gets_frames_and_its_answers_make_the_latency(output):
    with connect(f"ws://{output.address}") as page:
        greeting = json.loads(page.recv(timeout=2))
        assert (greeting["type"], greeting["version"]) == ("hello", 1)
        assert greeting["layout"] == _LAYOUT.to_json()
        _until(lambda: output.pages == 1)
        output.show(_frame(5, 0.25))
        frame = json.loads(page.recv(timeout=2))
        assert (frame["type"], frame["index"]) == ("theta", 5)
        assert frame["theta"] == [0.25] * _LAYOUT.size
        time.sleep(0.05)
        for text in ('{"type":"shown","index":5}', '{"type":"shown","index":99}', "garbage", "[]"):
            page.send(text)
        _until(lambda: output.latencies.shown == 1)
        assert 0.05 <= output.latencies.quantile_s(0.5) < 0.5
    _until(lambda: output.pages == 0)


def test_many_pages_stay_connected_and_one_too_many_is_told(output):
    with contextlib.ExitStack() as opened:
        pages = [opened.enter_context(connect(f"ws://{output.address}")) for _ in range(64)]
        for page in pages:
            page.recv(timeout=2)
        with pytest.raises(InvalidStatus) as refused:
            connect(f"ws://{output.address}")
        assert refused.value.response.status_code == 503
        assert b"close one" in refused.value.response.body
        # Fetching the page takes no conversation's place, however often.
        for _ in range(40):
            with urllib.request.urlopen(f"http://{output.address}/", timeout=2) as answer:
                assert answer.read() == b"<html>it"
        output.show(_frame(7))
        assert {json.loads(page.recv(timeout=2))["index"] for page in pages} == {7}
        pages[0].close()
        _until(lambda: output.pages == 63)

        def has_place():
            with contextlib.suppress(InvalidStatus), connect(f"ws://{output.address}") as page:
                return json.loads(page.recv(timeout=2))["type"] == "hello"
            return False

        _until(has_place)


def test_connections_that_say_nothing_make_room(output):
    silent = [socket.create_connection(output.address.split(":")) for _ in range(40)]
    try:
        with connect(f"ws://{output.address}") as page:
            assert json.loads(page.recv(timeout=2))["type"] == "hello"
        silent[0].settimeout(2)
        assert silent[0].recv(1) == b"", "the oldest was hung up on"
    finally:
        for one in silent:
            one.close()


def test_a_slow_page_gets_the_newest(output):
    with connect(f"ws://{output.address}") as page:
        page.recv(timeout=2)
        _until(lambda: output.pages == 1)
        for index in range(200):
            output.show(_frame(index))
        time.sleep(0.2)
        indices = []
        while not indices or indices[-1] != 199:
            indices.append(json.loads(page.recv(timeout=2))["index"])
    assert indices == sorted(indices)
    assert len(indices) < 200


def test_a_page_is_told_how_it_goes_once(output):
    with connect(f"ws://{output.address}") as page:
        page.recv(timeout=2)
        _until(lambda: output.pages == 1)
        output.tell("25 pictures/s")
        output.tell("25 pictures/s")
        assert json.loads(page.recv(timeout=2)) == {"type": "status", "text": "25 pictures/s"}
        output.show(_frame(1))
        assert json.loads(page.recv(timeout=2))["type"] == "theta"


def test_a_page_may_ask_for_a_calibration(output):
    with connect(f"ws://{output.address}") as page:
        page.send('{"type":"calibrate"}')
        assert output.asked.wait(2)


def test_a_page_is_told_the_end(output):
    with connect(f"ws://{output.address}") as page:
        page.recv(timeout=2)
        _until(lambda: output.pages == 1)
        threading.Thread(target=output.close).start()
        assert json.loads(page.recv(timeout=2))["text"] == "The performance has ended."


def test_a_page_that_comes_with_the_end_is_told_it_too(output):
    output._closed = True
    with connect(f"ws://{output.address}") as page:
        page.recv(timeout=2)
        assert json.loads(page.recv(timeout=2))["text"] == "The performance has ended."


def test_the_address_itself_is_the_page_and_nothing_else_is_there(output):
    with urllib.request.urlopen(f"http://{output.address}/?ws=ws://{output.address}") as answer:
        assert answer.read() == b"<html>it"
        assert answer.headers["Content-Type"].startswith("text/html")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"http://{output.address}/etc/passwd")


def test_other_machines_reach_it_only_when_asked_for(output):
    with pytest.raises(UserError, match="Other machines could reach"):
        PageOutput(_LAYOUT, "0.0.0.0:0")
    with pytest.raises(UserError, match="Nothing can be served"):
        PageOutput(_LAYOUT, output.address)


def _answer_to(address, host, **headers):
    """The status of a WebSocket's handshake that asks for this host."""
    number, port = address.rsplit(":", 1)
    headers |= {
        "Host": host,
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    with socket.create_connection((number, int(port)), 5) as asking:
        asking.sendall(f"GET / HTTP/1.1\r\n{lines}\r\n".encode())
        return int(asking.recv(100).split()[1])


def test_other_machines_get_the_page_and_may_be_driven_where_it_is_allowed():
    """By this machine's number or name; a name of the web's may have been pointed here."""
    shown = PageOutput(_LAYOUT, "0.0.0.0:0", allow_remote=True, page=lambda: b"<html>it")
    try:
        here = f"127.0.0.1:{shown.address.rsplit(':', 1)[1]}"
        assert not shown.address.startswith("0.0.0.0")
        assert shown.keyed_address.startswith(f"{here}/")
        for host in ("192.168.7.7:80", socket.gethostname(), f"{socket.gethostname()}.local:7072"):
            assert _answer_to(here, host, Origin=f"http://{host}") == 101
            assert _answer_to(here, host, Origin="http://192.168.7.8") == 403
            assert _answer_to(here, host, Origin="null") == 403
        assert _answer_to(here, "evil.example", Origin="http://evil.example") == 421
        assert _answer_to(here, "host.docker.internal") == 101, "a program"
    finally:
        shown.close()


def test_a_server_for_this_machine_is_not_asked_by_another_number(output):
    assert _answer_to(output.address, "192.168.7.7", Origin="http://192.168.7.7") == 421


def test_what_was_captured_is_not_remembered_for_ever(output):
    for index in range(2000):
        output.show(_frame(index))
    assert len(output._captured_s) == 500
