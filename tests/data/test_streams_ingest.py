"""The worker between stream and pools: nothing lost in silence, nobody made to wait."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import LocalGlobalPools
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.data.streams import FrameStream, Ingest, ReplayBuffer, StreamedFrame
from rgbavatar_ns.data.streams.ingest import FrameQueue
from rgbavatar_ns.data.streams.sequence_numbers import SeenNumbers
from tests.data.streaming import DEADLINE_S, GivenStream, streamed, subject, until
from tests.fuzz.messages import chunk


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
    near = replace(streamed(11).camera, focal_px=torch.full((1, 2), 1e9))
    away = replace(streamed(12).camera, world_to_camera=streamed(12).camera.world_to_camera * 1e5)
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
        replace(streamed(9), theta=streamed(9).theta * 1e5),
        replace(streamed(10), theta=streamed(10).theta * 0 + 1e30),
        replace(streamed(11), camera=near),
        replace(streamed(12), camera=away),
        replace(streamed(14), index=2**62 - 1),
        streamed(13),
        streamed(0, session="again"),
    ):
        ingest.take_in(frame)
    assert ingest.counts() == {
        "arrived": 0,
        "taken in": 6,
        "out of order": 2,
        "duplicate": 1,
        "theta not finite": 1,
        "theta of another size": 1,
        "theta absurd": 2,
        "camera absurd": 2,
        "another resolution": 2,
        "unreadable": 2,
        "dropped": 0,
    }
    assert frames.num_added == 6
    # The first of each kind is told.
    assert len(told) == 6
    assert [line for line in told if "24 x 16" in line and "12 x 8" in line] == told[2:3]


class _Film(GivenStream):
    """One that can begin in its middle."""

    went_on_after: int | None = None

    def go_on_after(self, index: int) -> None:
        self.went_on_after = index


@pytest.mark.parametrize(
    ("before", "now", "goes_on"), [("a", "a", True), ("", "a", True), ("a", "b", False)]
)
def test_another_film_is_not_gone_on_with_in_its_middle(before: str, now: str, goes_on: bool):
    first, _ = ingest_of()
    first.take_in(streamed(7, session=before))
    film, who = _Film([streamed(0, session=now)]), replace(subject(), session=now)
    second = Ingest(film, who, ReplayBuffer(who, LocalGlobalPools(150, 1000)))
    second.load_state_dict(first.state_dict())
    assert second.goes_on == goes_on
    assert film.went_on_after == (7 if goes_on else None)
    second.take_in(streamed(7, session=now))
    assert second.counts()["duplicate"] == (before == now), "its numbers are its own"


def test_a_png_is_not_longer_than_its_pixels():
    ingest, frames = ingest_of()
    png = streamed(0).png or b""
    filled = png[:33] + chunk(b"teXt", bytes(1 << 17)) + png[33:]
    replace(streamed(0), png=filled).decode()
    ingest.take_in(replace(streamed(0), png=filled))
    assert (ingest.counts()["unreadable"], frames.num_added) == (1, 0)


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


def test_frames_come_in_while_a_checkpoint_encodes_images(monkeypatch: pytest.MonkeyPatch):
    ingest, frames = ingest_of()
    for index in range(2):
        ingest.take_in(streamed(index, encode=False))
    finished: list[bool] = []

    def encode(image: np.ndarray) -> bytes:
        thread = threading.Thread(
            target=ingest.take_in, args=(streamed(7 + len(finished), encode=False),), daemon=True
        )
        thread.start()
        thread.join(DEADLINE_S / 10)
        finished.append(not thread.is_alive())
        return encode_png_rgba(image)

    monkeypatch.setattr("rgbavatar_ns.data.streams.replay_buffer.encode_png_rgba", encode)
    state = ingest.state_dict()
    assert finished == [True, True]
    assert frames.num_added == 4
    # The checkpoint is of the moment at which it was asked for, in all of its parts.
    assert state["counts"]["taken in"] == state["frames"]["added"] == 2
    assert len(state["frames"]["png_bytes"]) == len(state["frames"]["theta"]) == 2
    again, resumed = ingest_of()
    again.load_state_dict(state)
    assert [serial for serial, _ in resumed.held()] == [0, 1]


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
    assert len(seen.state_dict()["seen"]) <= 8192
    again = SeenNumbers()
    again.load_state_dict(seen.state_dict())
    assert again.newest == last + 10
    assert again.add(last + 5) == "duplicate"
    assert again.add(last + 6) == "new"


@pytest.mark.parametrize("far", [2**62 - 1, 1_000_000])
@pytest.mark.parametrize("before", [0, 1, 5])
def test_a_number_far_ahead_costs_no_other_frame(before: int, far: int):
    seen = SeenNumbers()
    numbers = [*range(before), far, *range(before, before + 20)]
    verdicts = [seen.add(number) for number in numbers]
    assert "duplicate" not in verdicts
    assert verdicts.count("late") == 1  # the one that follows it
    assert seen.add(far) == "duplicate"


def test_numbers_may_be_times():
    seen = SeenNumbers()
    assert {seen.add(1_700_000_000_000_000 + 40_000 * frame) for frame in range(50)} == {"new"}
