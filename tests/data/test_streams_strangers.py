"""What strangers may send to a listening stream: counted or refused, and others go on."""

import contextlib
import errno
import socket
import threading
import time

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection, connect

from rgbavatar_ns.data.streams import SocketStream, StreamClient, message_format
from rgbavatar_ns.data.streams.address import StreamAddress
from rgbavatar_ns.errors import UserError
from tests.data.streaming import (
    DEADLINE_S,
    Clock,
    Opener,
    indices,
    same,
    sending,
    subject,
    take,
    tracked,
    until,
)


def stranger(stream: SocketStream, **options) -> ClientConnection:
    """A client of its own making."""
    return connect(f"ws://{stream.address}", proxy=None, **options).__enter__()


@pytest.mark.parametrize("greeting", [message_format.frame_message(tracked(0)), b"junk", "text"])
def test_who_does_not_begin_with_a_subject_is_refused(stream: SocketStream, greeting: bytes | str):
    client = stranger(stream)
    client.send(greeting)
    assert str(client.recv(DEADLINE_S)).startswith("refused ")
    with pytest.raises(ConnectionClosed):
        client.recv(DEADLINE_S)
    assert stream.subject(0.0) is None
    assert stream.counts == {"refused clients": 1}


def test_a_subject_is_not_waited_for_for_ever(open_stream: Opener):
    stream = open_stream(silence_s=0.01)
    assert "No subject has come in time" in str(stranger(stream).recv(DEADLINE_S))


def test_web_pages_are_kept_out(stream: SocketStream):
    with pytest.raises(InvalidStatus, match="403"):
        stranger(stream, origin="https://example.org")


def test_bad_messages_are_counted_told_once_and_cost_nothing_else(open_stream: Opener):
    told: list[str] = []
    stream = open_stream(tell=told.append, grace_s=DEADLINE_S)
    client = stranger(stream)
    bad = message_format.encode({"type": "frame", "index": "\x1b[2J"})
    messages = [message_format.subject_message(subject()), bad, "text", b"", b"\xff" * 1000]
    messages += [message_format.frame_message(tracked(0)), message_format.encode({"type": []})]
    messages += [message_format.frame_message(tracked(1), b"cut short")]
    for message in messages:
        client.send(message)
    got = take(stream, 2)
    assert same(tracked(0), got[0])
    with pytest.raises(UserError, match="not a PNG"):
        got[1].decode()
    client.send(message_format.end_message())
    until(lambda: stream.ended)
    assert stream.counts == {"unreadable": 5}
    assert len(told) == 1
    assert "no whole number" in told[0]
    assert told[0].isprintable()


def test_too_large_a_message_costs_its_client_the_connection(
    open_stream: Opener, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(message_format, "LARGEST_MESSAGE", 100_000)
    stream = open_stream(grace_s=DEADLINE_S)
    client = stranger(stream)
    client.send(message_format.subject_message(subject()))
    assert client.recv(DEADLINE_S) == "accepted 0"
    client.send(bytes(200_000))
    with pytest.raises(ConnectionClosed):
        client.recv(DEADLINE_S)
    with StreamClient(subject(), stream.address) as other:
        other.send(tracked(0))
        with pytest.raises(UserError, match="too large"):
            other.send(tracked(1), png=bytes(200_000))
    assert indices(stream, 10) == [0]
    assert stream.counts == {"source lost": 1, "reconnects": 1}


def raw(stream: SocketStream, *messages: bytes) -> socket.socket:
    """A connection that has shaken hands and sent these; nothing reads what comes back."""
    client = socket.create_connection(StreamAddress.parse(stream.address), DEADLINE_S)
    client.sendall(HANDSHAKE)
    assert b" 101 " in client.recv(4096)
    for message in messages:
        client.sendall(ws_frame(Opcode.BINARY, message))
    return client


def ws_frame(opcode: Opcode, data: bytes, fin: bool = True) -> bytes:
    return Frame(opcode, data, fin).serialize(mask=True)


HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
GREETING = message_format.subject_message(subject())
WHOLE = ws_frame(Opcode.BINARY, message_format.frame_message(tracked(0)))
STALLING = {
    "one frame byte by byte": [WHOLE[place : place + 1] for place in range(100)],
    "fragments without end": [ws_frame(Opcode.BINARY, b"x", fin=False)]
    + [ws_frame(Opcode.CONT, b"x", fin=False)] * 50,
    "pings": [ws_frame(Opcode.PING, b"x")] * 50,
    "nothing of use": [ws_frame(Opcode.BINARY, b"x"), ws_frame(Opcode.TEXT, b"x")] * 20,
    "frames of no subject": [ws_frame(Opcode.BINARY, message_format.encode({"type": "frame"}))] * 9,
}


@pytest.mark.parametrize("how", STALLING)
def test_only_whole_frames_keep_the_place(open_stream: Opener, how: str):
    clock = Clock()
    stream = open_stream(clock=clock, grace_s=0.05)
    with raw(stream, GREETING) as stalling:
        assert stream.subject(DEADLINE_S) is not None
        for part in STALLING[how]:
            stalling.sendall(part)
            clock.now_s += 11.0 / len(STALLING[how])
        if how not in ("one frame byte by byte", "fragments without end", "pings"):
            until(lambda: stream.counts["unreadable"] == len(STALLING[how]))
        clock.now_s += 1.0
        with StreamClient(subject(), stream.address, patience_s=5.0) as second:
            second.send(tracked(1))
        assert indices(stream, 10) == [1]


def test_who_sends_pings_and_reads_no_answer_stops_nobody(open_stream: Opener):
    clock = Clock()
    stream = open_stream(clock=clock, grace_s=0.05)
    clients = []
    for index in (0, 1):
        clock.now_s += 11.0
        client = raw(stream, GREETING, message_format.frame_message(tracked(index)))
        clients.append(client)
        assert indices(stream, 1) == [index]
        client.settimeout(0.2)
        flood = ws_frame(Opcode.PING, bytes(125)) * 1000
        with contextlib.suppress(OSError):  # Until neither side's buffers take any more.
            while True:
                client.sendall(flood)
    began_s = time.monotonic()
    stream.close()
    assert time.monotonic() - began_s < 10.0
    for client in clients:
        client.close()


def test_connections_without_end_leave_room_for_a_client(stream: SocketStream):
    threads = threading.active_count()
    address = StreamAddress.parse(stream.address)
    with contextlib.ExitStack() as opened:
        with contextlib.closing(StreamClient(subject("mine"), stream.address)) as first:
            for number in range(100):
                idle = opened.enter_context(socket.create_connection(address, DEADLINE_S))
                with contextlib.suppress(OSError):
                    idle.sendall(HANDSHAKE[: (0, 30, len(HANDSHAKE))[number % 3]])
            assert threading.active_count() - threads < 60
            first.send(tracked(0))  # The client is not hung up on.
        with StreamClient(subject("mine"), stream.address) as second:
            second.send(tracked(1))
    assert indices(stream, 10) == [0, 1]
    assert stream.counts["reconnects"] == 1


def test_a_listener_without_files_listens_again(
    stream: SocketStream, monkeypatch: pytest.MonkeyPatch
):
    plain, failures = socket.socket.accept, []

    def accept(self: socket.socket) -> tuple[socket.socket, object]:
        if len(failures) < 3:
            failures.append(1)
            raise OSError(errno.EMFILE, "Too many open files")
        return plain(self)

    monkeypatch.setattr(socket.socket, "accept", accept)
    with sending("", stream.address, range(3)):
        assert indices(stream, 10) == [0, 1, 2]
    assert len(failures) == 3
