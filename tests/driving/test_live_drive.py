"""From source to outputs: nothing lost offline, nothing late live, every end a clean one."""

import threading
import time
from collections import Counter

import pytest
import torch

from rgbavatar_ns.driving import live_drive
from rgbavatar_ns.driving.live_drive import DrivenFrame, Latencies, LiveDrive
from rgbavatar_ns.driving.source import PerformanceFrame
from rgbavatar_ns.errors import UserError


class _Transfer:
    """In place of `LiveTransfer`: theta is the frame's number."""

    calibrating = False

    def __init__(self):
        self.asked = 0

    def __call__(self, frame):
        return torch.tensor([float(frame.index)])

    def calibrate(self):
        self.asked += 1

    def learn(self, frame):
        raise AssertionError("nothing is to be learnt")

    def conclude(self):
        raise AssertionError("nothing was learnt")


class _Source:
    head, waits_for = None, "a face"

    def __init__(self, count, every_s=0.0, error=None):
        self.counts = Counter()
        self.closed = False
        self._count, self._every_s, self._error, self._next = count, every_s, error, 0

    @property
    def ended(self):
        return self._next >= self._count and self._error is None

    def next(self, timeout_s):
        time.sleep(self._every_s)
        if self._next >= self._count:
            raise self._error
        self._next += 1
        return PerformanceFrame(self._next, time.monotonic(), self._next / 25)

    def close(self):
        self.closed = True


class _Output:
    def __init__(self, seconds=0.0, error=None):
        self.latencies, self.seen, self.closed = Latencies(), [], False
        self._seconds, self._error = seconds, error

    def show(self, frame: DrivenFrame):
        time.sleep(self._seconds)
        if self._error is not None:
            raise self._error
        self.seen.append(int(frame.theta))
        self.latencies.add(frame.captured_s, time.monotonic())

    def tell(self, line):
        self.told = line

    def close(self):
        self.closed = True


class _Empty(_Output):
    """As a film: without a picture it fails when it is closed."""

    def close(self):
        super().close()
        raise UserError("film.mp4 has no picture.", "Show a face.")


def test_offline_every_frame_is_shown_in_order():
    source, output = _Source(50), _Output(0.002)
    LiveDrive(source, _Transfer(), [output], real_time=False).run()
    assert output.seen == list(range(1, 51))
    assert source.closed
    assert output.closed


@pytest.mark.parametrize("slow_s", [0.0, 0.03])
@pytest.mark.parametrize(("seconds", "count"), [(0.8, 20), (0.04, 1), (0.05, 2), (99.0, 50)])
def test_seconds_of_a_recording_are_its_own_however_long_they_take(slow_s, seconds, count):
    source, output = _Source(50), _Output(slow_s)
    LiveDrive(source, _Transfer(), [output], real_time=False, seconds=seconds).run()
    assert output.seen == list(range(1, count + 1)), "25 frames a second"


class _Learning(_Transfer):
    """Wants five frames before it knows the performer; tells what it knew of each."""

    def __init__(self):
        super().__init__()
        self.learnt, self.knew, self.concluded = [], [], False

    @property
    def calibrating(self):
        return len(self.learnt) < 5 and not self.concluded

    def learn(self, frame):
        self.learnt.append(frame.index)

    def conclude(self):
        self.concluded = True

    def __call__(self, frame):
        self.knew.append(len(self.learnt))
        if self.calibrating:
            self.learnt.append(frame.index)
        return super().__call__(frame)


@pytest.mark.parametrize("count", [20, 3])
def test_a_film_begins_once_the_performers_rest_is_known(count):
    transfer, output = _Learning(), _Output()
    LiveDrive(_Source(count), transfer, [output], real_time=False).run()
    assert output.seen == list(range(1, count + 1))
    assert transfer.knew[0] == min(count, 5), "all that was to be learnt, or all there was"
    assert transfer.learnt == list(range(1, min(count, 5) + 1)), "each once"


def test_seconds_that_are_too_few_to_learn_from_are_shown_all_the_same():
    transfer, output = _Learning(), _Output()
    LiveDrive(_Source(20), transfer, [output], real_time=False, seconds=0.12).run()
    assert output.seen == transfer.learnt == [1, 2, 3]
    assert transfer.concluded


def test_live_nobody_waits_for_the_calibration():
    transfer, output = _Learning(), _Output()
    LiveDrive(_Source(20, every_s=0.01), transfer, [output]).run()
    assert transfer.knew[0] == 0


def test_live_a_slow_output_skips_and_never_falls_behind():
    source, output = _Source(60, every_s=0.01), _Output(0.05)
    drive = LiveDrive(source, _Transfer(), [output])
    drive.run()
    assert output.seen == sorted(output.seen)
    assert 5 < len(output.seen) < 30
    assert drive.not_drawn > 20
    assert output.latencies.quantile_s(1.0) < 0.2


def test_the_sources_error_is_told_after_everything_is_closed():
    source, output = _Source(3, error=UserError("The camera is gone.", "Connect it.")), _Output()
    with pytest.raises(UserError, match="camera is gone"):
        LiveDrive(source, _Transfer(), [output], real_time=False).run()
    assert output.seen == [1, 2, 3]
    assert source.closed
    assert output.closed


def test_what_ends_it_is_told_rather_than_the_film_that_it_leaves_empty():
    gone = UserError("The camera is gone.", "Connect it.")
    source, film, page = _Source(0, error=gone), _Empty(), _Output()
    with pytest.raises(UserError, match="camera is gone"):
        LiveDrive(source, _Transfer(), [film, page]).run()
    assert source.closed
    assert film.closed
    assert page.closed


def test_an_empty_film_is_told_after_everything_is_closed():
    source, film, page = _Source(0), _Empty(), _Output()
    with pytest.raises(UserError, match="has no picture"):
        LiveDrive(source, _Transfer(), [page, film, page]).run()
    assert source.closed
    assert page.closed


def test_an_outputs_error_ends_the_source_too():
    source, output = _Source(1000, every_s=0.001), _Output(error=BrokenPipeError())
    with pytest.raises(BrokenPipeError):
        LiveDrive(source, _Transfer(), [output]).run()
    assert source.closed
    assert output.closed


def test_it_can_be_stopped_and_asked_to_calibrate_from_other_threads():
    source, output, transfer = _Source(10_000, every_s=0.005), _Output(), _Transfer()
    drive = LiveDrive(source, transfer, [output])
    threading.Timer(0.1, drive.calibrate).start()
    threading.Timer(0.4, drive.stop).start()
    began_s = time.monotonic()
    drive.run()
    assert time.monotonic() - began_s < 3
    assert transfer.asked == 1
    assert output.closed


def test_who_waits_is_told_for_what():
    told = []
    source, output = _Source(10_000), _Output()
    source.next = lambda timeout_s: time.sleep(0.05)  # type: ignore[method-assign]
    drive = LiveDrive(source, _Transfer(), [output], tell=told.append)
    threading.Timer(2.6, drive.stop).start()
    drive.run()
    assert told[-1] == output.told == "Waiting for a face; Ctrl-C ends."


def test_while_a_films_beginning_is_learnt_from_nobody_is_waited_for(monkeypatch):
    monkeypatch.setattr(live_drive, "_SILENT_S", 0.0)
    monkeypatch.setattr(live_drive, "_TOLD_EVERY_S", 0.02)
    told = []
    source = _Source(5, every_s=0.2)
    LiveDrive(source, _Learning(), [_Output()], real_time=False, tell=told.append).run()
    assert "0 frames; learning the neutral face" in told
    seen = told.index("0 frames; learning the neutral face")
    assert not any(line.startswith("Waiting") for line in told[seen:])


def test_latencies_are_kept_for_two_minutes_and_no_longer():
    latencies = Latencies()
    for k in range(10_000):
        latencies.add(k / 25, k / 25 + (0.05 if k % 10 else 0.2))
    assert latencies.shown == 10_000
    assert latencies.frames_per_second() == pytest.approx(25, rel=0.01)
    assert latencies.quantile_s(0.5) == pytest.approx(0.05)
    assert latencies.quantile_s(0.95) == pytest.approx(0.2)
    assert len(latencies._seconds) == 3000
