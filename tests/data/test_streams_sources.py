"""Replay, folder and socket give every frame once, bit for bit, and live through their faults."""

import dataclasses
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.data.streams import (
    FolderStream,
    FolderWriter,
    PushedStream,
    ReplayStream,
    StreamClient,
)
from rgbavatar_ns.data.streams import message_format as wire
from rgbavatar_ns.data.streams.address import StreamAddress
from rgbavatar_ns.data.streams.socket_server import _CHUNK_BYTES, ACCEPTED
from rgbavatar_ns.errors import UserError
from tests.data.small_dataset import NUM_FRAMES, NUM_TEST, small_dataset
from tests.data.streaming import HEAD, same, subject, take, tracked, until


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TrackedDataset:
    return small_dataset(tmp_path_factory.mktemp("replayed") / "data", HEAD, per_frame_camera=True)


@pytest.fixture
def pushed():
    stream = PushedStream("127.0.0.1:0")
    yield stream
    stream.close()


def in_background(work) -> threading.Thread:
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


def test_replay_gives_the_training_frames_in_time(dataset: TrackedDataset):
    stream = ReplayStream(dataset, frames_per_second=50.0)
    began = time.monotonic()
    frames = take(stream, 100)
    took = time.monotonic() - began
    assert [frame.index for frame in frames] == list(range(NUM_FRAMES - NUM_TEST))
    assert stream.ended
    # The last of five frames is due four intervals after the first.
    assert took >= 0.08
    arrivals = np.array([frame.arrived_s for frame in frames])
    np.testing.assert_allclose(np.diff(arrivals), 0.02, atol=1e-6)
    assert all(same(tracked(frame.index), frame) for frame in frames)


def test_replay_goes_on_in_the_middle_and_shows_frames_again(dataset: TrackedDataset):
    stream = ReplayStream(dataset, frames_per_second=1000.0)
    stream.go_on_after(2)
    assert [frame.index for frame in take(stream, 100)] == [3, 4]
    assert same(tracked(1), stream.again(1))
    with pytest.raises(UserError, match="no frame 99"):
        stream.again(99)
    with pytest.raises(UserError, match="frames a second cannot"):
        ReplayStream(dataset, 0.0)


def test_folder_gives_what_is_there_and_what_comes(tmp_path: Path):
    stream = FolderStream(tmp_path / "live")
    assert stream.subject(0.02) is None
    assert stream.next(0.02) is None
    writer = FolderWriter(tmp_path / "live", subject())
    for index in (2, 0):
        writer.send(tracked(index))
    got = take(stream, 2)
    assert [frame.index for frame in got] == [0, 2]
    assert all(same(tracked(frame.index), frame) for frame in got)
    # Late and early ones, each once.
    for index in (1, 7):
        writer.send(tracked(index))
    writer.end()
    assert [frame.index for frame in take(stream, 10)] == [1, 7]
    assert stream.ended


def test_folder_lives_through_damaged_files_and_its_absence(tmp_path: Path):
    folder = tmp_path / "live"
    writer = FolderWriter(folder, subject())
    writer.send(tracked(0))
    (folder / "frame-0000000001.rga").write_bytes(b"garbage")
    (folder / "frame-0000000002.rga").mkdir()
    (folder / "notes.txt").write_text("not a frame")
    stream = FolderStream(folder)
    assert [frame.index for frame in take(stream, 1)] == [0]
    assert stream.next(0.05) is None
    assert stream.counts["garbage bytes"] == len(b"garbage")
    assert stream.counts["unreadable"] == 1
    folder.rename(tmp_path / "away")
    assert stream.next(0.1) is None
    assert stream.counts["source lost"] == 1
    (tmp_path / "away").rename(folder)
    writer.send(tracked(3))
    assert [frame.index for frame in take(stream, 1)] == [3]


def test_folder_passes_over_what_a_resumed_run_has_seen(tmp_path: Path):
    writer = FolderWriter(tmp_path / "live", subject())
    for index in range(6):
        writer.send(tracked(index))
    writer.end()
    stream = FolderStream(tmp_path / "live")
    assert take(stream, 1)[0].index == 0
    stream.go_on_after(3)
    assert [frame.index for frame in take(stream, 10)] == [4, 5]
    with pytest.raises(UserError, match="holds a stream already"):
        FolderWriter(tmp_path / "live", subject())


def test_folder_with_another_file_for_a_subject_is_refused(tmp_path: Path):
    (tmp_path / "subject.rga").write_bytes(wire.frame_record(tracked(0)))
    with pytest.raises(UserError, match="no subject"):
        FolderStream(tmp_path).subject(0.1)


def test_a_client_in_another_thread_is_heard(pushed: PushedStream):
    def send() -> None:
        with StreamClient(subject(), pushed.address) as client:
            for index in range(20):
                client.send(tracked(index))

    thread = in_background(send)
    assert pushed.subject(10.0) is not None
    got = take(pushed, 100)
    thread.join()
    assert [frame.index for frame in got] == list(range(20))
    assert all(same(tracked(frame.index), frame) for frame in got)
    assert pushed.ended
    assert not +pushed.counts


def test_unix_socket(tmp_path: Path):
    place = tmp_path / "stream"
    stream = PushedStream(f"unix:{place}")
    assert place.stat().st_mode & 0o777 == 0o600
    thread = in_background(lambda: StreamClient(subject(), f"unix:{place}").send(tracked(4)))
    assert same(tracked(4), take(stream, 1)[0])
    thread.join()
    with pytest.raises(UserError, match="cannot be listened"):
        PushedStream(f"unix:{place}")
    stream.close()
    assert not place.exists()
    # Left behind by a program that was killed.
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(place))
    PushedStream(f"unix:{place}").close()


def test_a_second_client_is_refused_and_the_first_goes_on(pushed: PushedStream):
    ready, done = threading.Event(), threading.Event()
    refused = []

    def first() -> None:
        client = StreamClient(subject(), pushed.address)
        client.send(tracked(0))
        ready.set()
        done.wait(30)
        client.send(tracked(1))
        client.end()
        client.close()

    def second() -> None:
        ready.wait(30)
        try:
            StreamClient(subject(), pushed.address, patience_s=5.0)
        except UserError as error:
            refused.append(error)
        done.set()

    threads = [in_background(first), in_background(second)]
    got = take(pushed, 10)
    for thread in threads:
        thread.join()
    assert [frame.index for frame in got] == [0, 1]
    assert len(refused) == 1
    assert "another client" in str(refused[0])
    assert pushed.counts["refused clients"] == 1


def test_a_lost_client_comes_back_and_goes_on(pushed: PushedStream):
    def send() -> None:
        client = StreamClient(subject("mine"), pushed.address)
        for index in range(3):
            client.send(tracked(index))
        client.close()  # without an end: it has crashed
        with StreamClient(subject("mine"), pushed.address) as again:
            again.send(tracked(3))

    thread = in_background(send)
    got = take(pushed, 10)
    thread.join()
    assert [frame.index for frame in got] == [0, 1, 2, 3]
    assert pushed.counts == {"source lost": 1, "reconnects": 1, "garbage bytes": 0}


def test_who_comes_while_the_lost_one_is_still_being_read_is_not_refused(pushed: PushedStream):
    place = StreamAddress.parse(pushed.address).place
    greeting, one = wire.subject_record(subject("mine")), wire.frame_record(tracked(0))
    repeats = 3 * _CHUNK_BYTES // len(one)  # more than is read at once
    answers = []

    def send() -> None:
        with socket.create_connection(place, timeout=10) as first:
            first.sendall(greeting)
            answers.append(first.recv(100))
            first.sendall(one * repeats)
        with socket.create_connection(place, timeout=10) as second:
            second.sendall(greeting + wire.end_record())
            answers.append(second.recv(100))

    thread = in_background(send)
    assert len(take(pushed, repeats + 1)) == repeats
    thread.join()
    assert answers == [ACCEPTED] * 2
    assert pushed.counts == {"source lost": 1, "reconnects": 1, "garbage bytes": 0}


def test_client_connects_again_where_the_server_has_hung_up():
    stream = PushedStream("127.0.0.1:0")
    address = stream.address
    restarted = threading.Event()
    sent = []

    def send() -> None:
        client = StreamClient(subject(), address, patience_s=20.0)
        sent.append(0)
        restarted.wait(30)
        # The first writes into a dead connection may still seem to work.
        for index in range(30):
            client.send(tracked(index))
            time.sleep(0.01)
        client.end()
        client.close()

    thread = in_background(send)
    until(lambda: stream.subject(0.05) is not None and sent)
    stream.close()
    again = PushedStream(address)
    restarted.set()
    got = take(again, 100)
    thread.join()
    indices = [frame.index for frame in got]
    assert indices[-1] == 29
    assert indices == list(range(indices[0], 30))
    again.close()


@pytest.mark.parametrize("data", [b"GET / HTTP/1.1\r\n\r\n" * 20, wire.frame_record(tracked(0))])
def test_who_does_not_begin_with_a_subject_is_hung_up_on(pushed: PushedStream, data: bytes):
    place = StreamAddress.parse(pushed.address).place
    with socket.create_connection(place, timeout=10) as stranger:
        stranger.sendall(data)
        assert pushed.subject(0.3) is None
        assert stranger.recv(100).startswith(b"REFUSED ")
    assert pushed.counts["refused clients"] == 1


def test_garbage_within_a_stream_costs_nothing_that_had_arrived(pushed: PushedStream):
    place = StreamAddress.parse(pushed.address).place
    with socket.create_connection(place, timeout=10) as client:
        garbage = bytes(range(256)) * 40
        parts = [wire.subject_record(subject()), wire.frame_record(tracked(0)), garbage]
        parts += [wire.frame_record(tracked(1)), wire.frame_record(tracked(2))[:100]]
        client.sendall(b"".join(parts))
        assert [frame.index for frame in take(pushed, 2)] == [0, 1]
    until(lambda: pushed.next(0.01) is None and pushed.counts["source lost"] == 1)
    assert pushed.counts["garbage bytes"] == len(garbage) + 100


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (subject(width=24), "12 x 8"),
        (
            dataclasses.replace(subject(), arrays=dataclasses.replace(HEAD.arrays, name="other")),
            "head",
        ),
    ],
)
def test_another_size_or_head_is_refused_by_name(pushed: PushedStream, other, told):
    failures = []

    def send() -> None:
        StreamClient(subject(), pushed.address).close()
        try:
            StreamClient(other, pushed.address, patience_s=5.0)
        except UserError as error:
            failures.append(str(error))

    thread = in_background(send)
    until(lambda: pushed.next(0.02) is None and not thread.is_alive())
    assert len(failures) == 1
    assert told in failures[0]


def test_without_a_listener_the_client_gives_up_with_a_reason():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(UserError, match="Nobody takes frames"):
            StreamClient(subject(), address, patience_s=0.3)


def test_only_this_machine_is_listened_to_unless_asked():
    with pytest.raises(UserError, match="Other machines"):
        PushedStream("0.0.0.0:0")
    PushedStream("0.0.0.0:0", allow_remote=True).close()


@pytest.mark.parametrize("text", ["7070", "localhost", "127.0.0.1:", "127.0.0.1:99999", ":7070"])
def test_addresses_that_are_none_are_refused(text: str):
    with pytest.raises(UserError, match="no address"):
        StreamAddress.parse(text)


@pytest.mark.parametrize("text", ["127.0.0.1:7070", "[::1]:80", "unix:/tmp/x", "localhost:1"])
def test_addresses_read_as_they_are_written(text: str):
    assert str(StreamAddress.parse(text)) == text
    assert StreamAddress.parse(text).is_local
