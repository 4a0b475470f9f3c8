"""The stream that recordings have to themselves, on a stand-in of a device's streams."""

from contextlib import contextmanager
from typing import Any

import pytest
import torch

from rgbavatar_ns.avatar.training.cuda_graph import lane, record_cuda_graph


class Streams:
    """Streams as lists of what was started on them; a wait takes over what the other holds."""

    def __init__(self, monkeypatch) -> None:
        self.current_device, self.captured_on = torch.device("cuda", 0), []
        self.first = {torch.device("cuda", i): FakeStream() for i in range(2)}
        self.entered: list[FakeStream] = []
        monkeypatch.setattr(torch.cuda, "Stream", FakeStream)
        monkeypatch.setattr(torch.cuda, "stream", self.stream)
        monkeypatch.setattr(torch.cuda, "device", self.device)
        monkeypatch.setattr(torch.cuda, "current_stream", self.current_stream)
        monkeypatch.setattr(torch.cuda, "CUDAGraph", FakeGraph)
        monkeypatch.setattr(torch.cuda, "graph", self.graph)

    def current_stream(self, device=None) -> "FakeStream":
        return self.entered[-1] if self.entered else self.first[device or self.current_device]

    @contextmanager
    def stream(self, stream):
        self.entered.append(stream)
        try:
            yield
        finally:
            self.entered.pop()

    @contextmanager
    def device(self, device):
        before, self.current_device = self.current_device, device
        try:
            yield
        finally:
            self.current_device = before

    @contextmanager
    def graph(self, graph, *, stream, capture_error_mode):
        self.captured_on.append((stream, capture_error_mode))
        yield


class FakeStream:
    def __init__(self, device=None) -> None:
        self.device = device
        self.known: list[str] = []

    def start(self, work: str) -> None:
        self.known.append(work)

    def wait_stream(self, other: "FakeStream") -> None:
        self.known += [work for work in other.known if work not in self.known]


class FakeGraph:
    def replay(self) -> None:
        stream: Any = torch.cuda.current_stream()
        stream.start("replayed")


@pytest.fixture
def streams(monkeypatch) -> Streams:
    return Streams(monkeypatch)


SECOND = torch.device("cuda", 1)


def test_what_is_started_in_a_lane_comes_after_what_was_and_before_what_follows(streams):
    """On the avatar's own device, whichever is the current one."""
    enter = lane(SECOND)
    around = streams.first[SECOND]
    around.start("before")
    with enter():
        assert streams.current_device == SECOND
        own = streams.current_stream()
        assert own is not around
        assert own.device == SECOND
        assert own.known == ["before"]
        own.start("within")
    assert streams.current_device == torch.device("cuda", 0)
    assert streams.current_stream() is streams.first[torch.device("cuda", 0)]
    assert around.known == ["before", "within"]


def test_a_lane_is_one_stream(streams):
    enter = lane(SECOND)
    seen = []
    for _ in range(2):
        with enter():
            seen.append(streams.current_stream())
    assert seen[0] is seen[1]


def test_what_failed_in_a_lane_is_waited_for_too(streams):
    enter = lane(SECOND)

    def fail() -> None:
        with enter():
            streams.current_stream().start("begun")
            raise RuntimeError("no memory")

    with pytest.raises(RuntimeError, match="no memory"):
        fail()
    assert streams.first[SECOND].known == ["begun"]


def test_a_recording_is_made_and_repeated_on_the_lane_s_stream(streams):
    enter, work = lane(SECOND), []
    with enter():
        own = streams.current_stream()
        replay = record_cuda_graph(lambda: work.append(streams.current_stream()))
        replay()
    assert work == [own]
    assert streams.captured_on == [(own, "thread_local")]
    assert own.known == ["replayed"]
    assert streams.first[SECOND].known == ["replayed"]


def test_a_cpu_has_no_lanes():
    with lane(torch.device("cpu"))():
        pass
