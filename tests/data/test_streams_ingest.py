"""The worker between stream and pools: nothing lost in silence, nobody made to wait."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import LocalGlobalPools
from rgbavatar_ns.data.streams import FrameStream, Ingest, ReplayBuffer, StreamedFrame
from rgbavatar_ns.data.streams.ingest import FrameQueue
from rgbavatar_ns.data.streams.sequence_numbers import SeenNumbers
from tests.data.streaming import DEADLINE_S, GivenStream, streamed, subject, until


def ingest_of(
    stream: FrameStream | None = None, queue_frames: int = 256, **more
) -> tuple[Ingest, ReplayBuffer]:
    frames = ReplayBuffer(subject(), LocalGlobalPools(150, 1000))
    return Ingest(stream or GivenStream([]), subject(), frames, queue_frames, **more), frames


LARGE = np.zeros((16, 24, 4), np.uint8)


@pytest.mark.parametrize("encode", [True, False])
def test_what_cannot_be_used_is_left_out_and_counted_by_name(encode: bool):
    nan = streamed(3).theta.clone()
    nan[5] = torch.nan
    told: list[str] = []
    ingest, frames = ingest_of(tell=told.append)
    for frame in (
        streamed(0, encode=encode),
        streamed(2, encode=encode),
        streamed(1, encode=encode),  # late, but new
        streamed(2, encode=encode),
        replace(streamed(3), theta=nan),
        replace(streamed(4), theta=torch.zeros(3)),
        streamed(5, image=LARGE, encode=encode),
        streamed(6, image=LARGE, encode=encode),
        replace(streamed(7), png=(streamed(7).png or b"")[:-20]),
        replace(streamed(8), png=b"no picture"),
        streamed(10_000),
        streamed(9),
        streamed(0, session="again"),
    ):
        ingest.take_in(frame)
    assert ingest.counts() == {
        "arrived": 0,
        "taken in": 5,
        "out of order": 1,
        "duplicate": 1,
        "theta not finite": 1,
        "theta of another size": 1,
        "another resolution": 2,
        "unreadable": 2,
        "too late": 1,
        "dropped": 0,
    }
    assert frames.num_added == 5
    assert len(told) == 1
    assert "24 x 16" in told[0]
    assert "12 x 8" in told[0]


def test_only_images_of_the_right_size_are_decoded(monkeypatch: pytest.MonkeyPatch):
    def decoded(self: StreamedFrame) -> None:
        raise AssertionError("a bomb went off")

    monkeypatch.setattr(StreamedFrame, "decode", decoded)
    ingest, _ = ingest_of()
    ingest.take_in(streamed(0, image=LARGE))
    assert ingest.counts()["another resolution"] == 1


def test_a_burst_of_200_frames_is_taken_in_whole_while_nobody_draws():
    stream = GivenStream([streamed(index) for index in range(200)])
    ingest, frames = ingest_of(stream)
    ingest.start()
    until(lambda: ingest.finished)
    ingest.close()
    assert ingest.failure is None
    assert stream.closed
    assert frames.num_added == 200
    assert frames.fill == (150, 50)
    assert ingest.counts() == {"arrived": 200, "taken in": 200, "dropped": 0}


@pytest.mark.parametrize(("keeps_frames", "arrived", "dropped"), [(False, 30, 22), (True, 9, 0)])
def test_a_full_queue_drops_the_oldest_or_has_its_source_wait(keeps_frames, arrived, dropped):
    stream = GivenStream([streamed(index) for index in range(30)], keeps_frames)
    ingest, frames = ingest_of(stream, queue_frames=8)
    ingest.listen()
    until(lambda: ingest.counts()["arrived"] == arrived)  # the ninth may wait at the queue
    ingest.start()
    until(lambda: ingest.finished)
    assert ingest.counts()["dropped"] == dropped
    assert frames.num_added == 30 - dropped
    assert [frame.index for _, frame in frames.held()] == list(range(dropped, 30))


def test_training_goes_on_while_the_stream_stalls():
    stalled, goes_on = threading.Event(), threading.Event()

    class Stalling(GivenStream):
        def next(self, timeout_s: float) -> StreamedFrame | None:
            frame = super().next(timeout_s)
            if self.ended:
                stalled.set()
                goes_on.wait(DEADLINE_S)
            return frame

    ingest, frames = ingest_of(Stalling([streamed(index) for index in range(4)]))
    ingest.start()
    assert stalled.wait(DEADLINE_S)
    until(lambda: frames.num_added == 3)
    for _ in range(5):
        assert len(frames.batch(10).serial) == 3
    assert not ingest.finished
    goes_on.set()
    until(lambda: ingest.finished)
    assert frames.num_added == 4


def test_a_fault_of_the_source_is_kept_for_who_asks():
    class Failing(GivenStream):
        def next(self, timeout_s: float) -> StreamedFrame | None:
            raise OSError("the disk is gone")

    ingest, _ = ingest_of(Failing([streamed(0)]))
    ingest.start()
    until(lambda: ingest.failure is not None)
    assert "disk is gone" in str(ingest.failure)


def test_ingest_goes_on_from_its_state():
    first, _ = ingest_of()
    for index in (0, 1, 1):
        first.take_in(streamed(index))
    second, resumed = ingest_of()
    second.load_state_dict(first.state_dict())
    assert resumed.num_added == 2
    for index in (1, 2):
        second.take_in(streamed(index))
    assert resumed.num_added == 3
    # The frame that had been there before is known again.
    assert second.counts() == {"arrived": 0, "taken in": 3, "duplicate": 2, "dropped": 0}


def test_queue_lets_nothing_in_once_closed():
    queue = FrameQueue(2)
    queue.put(streamed(0), wait=False)
    queue.close()
    queue.put(streamed(1), wait=True)
    first, then = queue.get(), queue.get()
    assert first is not None
    assert (first.index, then) == (0, None)


@pytest.mark.parametrize("last", [50, 20_000])
def test_numbers_are_judged_within_bounded_memory(last: int):
    seen = SeenNumbers()
    for number in range(last + 1):
        assert seen.add(number) == "new"
    assert seen.add(last) == "duplicate"
    assert seen.add(last - 5) == "duplicate"
    assert seen.add(last + 10) == "new"
    assert seen.add(last + 5) == "late"
    assert seen.add(last + 5) == "duplicate"
    assert len(seen.state_dict()["seen"]) <= 2 * 4096
    assert seen.add(last + 1_000_000) == "new"
    assert seen.add(last + 5) == "too late"
    again = SeenNumbers()
    again.load_state_dict(seen.state_dict())
    assert again.add(last + 1_000_000) == "duplicate"
