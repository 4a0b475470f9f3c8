"""Replay and socket give every frame once, bit for bit, and live through their faults."""

import contextlib
import dataclasses
import socket
import threading
from pathlib import Path

import numpy as np
import pytest

from rgbavatar_ns.data import TrackedDataset, TrackedFrame
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.data.streams import ReplayStream, SocketStream, StreamClient, message_format
from rgbavatar_ns.data.streams.address import StreamAddress
from rgbavatar_ns.errors import UserError
from tests.data.small_dataset import (
    HEIGHT,
    NUM_FRAMES,
    NUM_TEST,
    WIDTH,
    small_dataset,
    small_writer,
)
from tests.data.streaming import (
    DEADLINE_S,
    HEAD,
    Clock,
    Opener,
    indices,
    same,
    sending,
    subject,
    take,
    tracked,
)

FRAME_BYTES = len(message_format.frame_message(tracked(0)))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TrackedDataset:
    return small_dataset(tmp_path_factory.mktemp("replayed") / "data", HEAD, per_frame_camera=True)


def test_replay_gives_the_training_frames_in_time(dataset: TrackedDataset):
    clock = Clock()
    stream = ReplayStream(dataset, 50.0, clock, clock.sleep)
    began_s = clock.now_s
    assert stream.next(0.0) is not None
    assert stream.next(0.005) is None  # the second is due after .02 s
    assert clock.now_s == pytest.approx(began_s + 0.005)
    frames = take(stream, 100)
    assert [frame.index for frame in frames] == list(range(1, NUM_FRAMES - NUM_TEST))
    assert stream.ended
    arrivals_s = [frame.arrived_s - began_s for frame in frames]
    np.testing.assert_allclose(arrivals_s, [0.02, 0.04, 0.06, 0.08], atol=1e-6)
    assert clock.now_s == pytest.approx(began_s + 0.08)
    assert all(same(tracked(frame.index), frame) for frame in frames)


def test_replay_goes_on_in_the_middle_and_shows_frames_again(dataset: TrackedDataset):
    clock = Clock()
    stream = ReplayStream(dataset, 1000.0, clock, clock.sleep)
    stream.go_on_after(2)
    assert [frame.index for frame in take(stream, 100)] == [3, 4]
    assert same(tracked(1), stream.again(1))
    with pytest.raises(UserError, match="no frame 99"):
        stream.again(99)
    with pytest.raises(UserError, match="frames a second cannot"):
        ReplayStream(dataset, 0.0)


def test_a_replay_follows_the_numbers_in_whatever_order_they_are_listed(tmp_path: Path):
    writer = small_writer(tmp_path, HEAD)
    for index in (5, 2, 9, 0, 7):
        writer.add(tracked(index))
    listed = writer.finish({2})
    clock = Clock()
    stream = ReplayStream(listed, 50.0, clock, clock.sleep)
    assert [frame.index for frame in take(stream, 9)] == [0, 5, 7, 9]
    stream = ReplayStream(listed, 50.0, clock, clock.sleep)
    stream.go_on_after(5)
    assert [frame.index for frame in take(stream, 9)] == [7, 9]
    assert all(same(tracked(index), stream.again(index)) for index in (0, 2, 5, 7, 9))


def test_a_client_is_heard_and_made_to_wait(stream: SocketStream):
    assert stream.subject(0.0) is None
    assert stream.next(0.0) is None
    with sending("", stream.address, range(40)):
        got = take(stream, 100)
    assert stream.subject(0.0) is not None
    assert [frame.index for frame in got] == list(range(40))
    assert all(same(tracked(frame.index), frame) for frame in got)
    assert stream.ended
    assert not stream.counts


def test_a_second_client_is_refused_and_the_first_goes_on(open_stream: Opener):
    stream = open_stream(grace_s=0.05)
    first = StreamClient(subject("same name"), stream.address)
    first.send(tracked(0))
    with pytest.raises(UserError, match="Another client is connected"):
        StreamClient(subject("same name"), stream.address)
    first.send(tracked(1))
    first.end()
    assert indices(stream, 10) == [0, 1]
    assert stream.counts == {"refused clients": 1}


def test_a_silent_client_is_replaced(open_stream: Opener):
    clock = Clock()
    stream = open_stream(clock=clock, grace_s=0.05)
    first = StreamClient(subject(), stream.address)
    first.send(tracked(0))
    assert indices(stream, 1) == [0]
    clock.now_s += 11.0
    with StreamClient(subject(), stream.address) as second:
        second.send(tracked(1))
        # The first writes into a dead connection may seem to work.
        with pytest.raises(UserError, match="Another client is connected"):
            list(map(first.send, map(tracked, range(2, 100))))
    assert indices(stream, 10) == [1]


class Relay:
    """Passes bytes on to a stream, and breaks a connection after so many of them.

    `unnoticed`: the stream hears no more of it, as where a cable was pulled out.
    """

    def __init__(self, address: str, *limits: int, unnoticed: bool = False) -> None:
        self._to, self._unnoticed = StreamAddress.parse(address), unnoticed
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._serve, args=(limits,), daemon=True).start()

    def _serve(self, limits: tuple[int, ...]) -> None:
        for limit in (*limits, 1 << 30):
            client, _ = self._listener.accept()
            server = socket.create_connection(self._to)
            threading.Thread(target=_pump, args=(server, client, 1 << 30), daemon=True).start()
            _pump(client, server, limit, *([client] if self._unnoticed else []))


def _pump(source: socket.socket, sink: socket.socket, limit: int, *ends: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while limit > 0 and (data := source.recv(min(limit, 4096))):
            limit -= len(data)
            sink.sendall(data)
    for end in ends or (source, sink):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


def test_what_a_lost_connection_had_on_its_way_is_sent_again(stream: SocketStream):
    with contextlib.closing(StreamClient(subject("mine"), stream.address)) as earlier:
        earlier.send(tracked(0))
        earlier.send(tracked(1))
    greeting = 400 + len(message_format.subject_message(subject("mine")))
    relay = Relay(stream.address, greeting + 3 * FRAME_BYTES, greeting + 5 * FRAME_BYTES)
    with sending("mine", relay.address, range(2, 30)):
        assert indices(stream, 100) == list(range(30))
    assert stream.counts == {"source lost": 3, "reconnects": 3}


def test_a_client_whose_lost_connection_was_not_noticed_takes_its_own_place(open_stream: Opener):
    stream = open_stream(grace_s=0.05)
    greeting = 400 + len(message_format.subject_message(subject()))
    relay = Relay(stream.address, greeting + 3 * FRAME_BYTES, unnoticed=True)
    with StreamClient(subject(), relay.address) as client:
        for index in range(12):
            client.send(tracked(index))
    assert indices(stream, 100) == list(range(12))
    assert stream.counts["reconnects"] == 1
    assert stream.counts["refused clients"] == 0


def test_another_program_may_go_on(stream: SocketStream):
    first = StreamClient(subject(), stream.address)
    first.send(tracked(0))
    first.close()
    with pytest.raises(RuntimeError, match="tracker"), StreamClient(subject(), stream.address):
        raise RuntimeError("the tracker broke; the stream has not ended")
    with StreamClient(subject(), stream.address) as last:
        last.send(tracked(1))
    assert indices(stream, 10) == [0, 1]
    assert stream.counts == {"source lost": 2, "reconnects": 2}


def test_a_client_goes_on_with_a_stream_that_was_started_again(open_stream: Opener):
    stream = open_stream()
    client = StreamClient(subject(), stream.address)
    client.send(tracked(0))
    assert indices(stream, 1) == [0]
    stream.close()
    assert stream.next(DEADLINE_S) is None
    again = open_stream(stream.address)
    client.send(tracked(1))
    client.end()
    client.close()
    # What the first one may not have saved comes once more.
    assert indices(again, 10) == [0, 1]


def test_a_client_that_brings_another_person_is_told_and_goes_on(open_stream: Opener):
    told: list[str] = []
    stream = open_stream(tell=told.append)
    own = subject().identity
    for k, person in enumerate((own, own + 1e-6, own + 0.1, own + 0.1)):
        client = StreamClient(dataclasses.replace(subject(), identity=person), stream.address)
        client.send(tracked(k))
        assert indices(stream, 1) == [k]
        client.close()
    assert len(told) == 1
    assert "another shape of the head" in told[0]


OTHER_ARRAYS = dataclasses.replace(HEAD.arrays, name="other")


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (subject(width=24), "12 x 8"),
        (dataclasses.replace(subject(), arrays=OTHER_ARRAYS), "head"),
    ],
)
def test_another_size_or_head_is_refused_by_name(stream: SocketStream, other, told):
    StreamClient(subject(), stream.address).close()
    with pytest.raises(UserError, match=told):
        StreamClient(other, stream.address)
    assert stream.counts["refused clients"] == 1


def test_without_a_listener_the_client_gives_up_with_a_reason():
    clock = Clock()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(UserError, match="Nobody takes frames"):
            StreamClient(subject(), address, clock=clock, sleep=clock.sleep)
    # Pauses of .25, .5, 1, 2, 4, 8, 10 ... s, as long as they end within a minute.
    assert clock.now_s == 1055.75


def test_closing_ends_who_waits(stream: SocketStream):
    client = StreamClient(subject(), stream.address)
    threading.Timer(0.05, stream.close).start()
    assert stream.next(DEADLINE_S) is None
    assert stream.ended
    assert stream.counts == {}
    client.close()


def test_an_address_is_local_free_and_readable(stream: SocketStream):
    with pytest.raises(UserError, match="cannot be listened"):
        SocketStream(stream.address)
    with pytest.raises(UserError, match="Other machines"):
        SocketStream("0.0.0.0:0")
    SocketStream("0.0.0.0:0", allow_remote=True).close()
    for text in ("7070", "localhost", "127.0.0.1:", "127.0.0.1:99999", ":7070", "a@b:1", "unix:/x"):
        with pytest.raises(UserError, match="no address"):
            StreamAddress.parse(text)
    for text in ("127.0.0.1:7070", "[::1]:80", "localhost:1"):
        assert str(StreamAddress.parse(text)) == text
        assert StreamAddress.parse(text).is_local
    assert not StreamAddress.parse("example.org:80").is_local


MANUAL = (Path(__file__).parents[2] / "docs/online.md").read_text().split("```python\n")[1:]


@pytest.mark.parametrize("program", [part.split("```")[0] for part in MANUAL])
def test_the_senders_in_the_manual_work(stream: SocketStream, program: str):
    own = "StreamClient" in program
    frames = [tracked(index) for index in range(5)]
    told = {"WIDTH": WIDTH, "HEIGHT": HEIGHT, "identity": subject().identity}
    told |= {"IDENTITY": subject().identity.tolist(), "LAYOUT": HEAD.layout.to_json()}

    def given(one: TrackedFrame) -> tuple:
        if own:
            return one.theta, one.camera, one.image_rgba
        camera = message_format.camera_to_json(one.camera, 0)
        return one.theta.tolist(), camera, encode_png_rgba(one.image_rgba)

    told["my_tracker"] = lambda: map(given, frames)
    exec(program.replace("127.0.0.1:7070", stream.address), told)
    got = take(stream, 10)
    assert len(got) == 5
    assert all(same(*pair) for pair in zip(frames, got))
    assert not stream.counts


def test_the_manual_names_both_senders():
    assert len(MANUAL) == 2
