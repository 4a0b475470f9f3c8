"""A dataset as a stream in real time: the paper's protocol for online reconstruction."""

import bisect
import time
from collections import Counter
from collections.abc import Callable

from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.data.streams.protocol import StreamedFrame, StreamSubject
from rgbavatar_ns.errors import UserError


class ReplayStream:
    """A dataset's training frames by their numbers, `frames_per_second` from the first `next` on.

    A frame counts as arrived at its time; frames that are overdue come at once.
    """

    keeps_frames = False

    def __init__(
        self,
        dataset: TrackedDataset,
        frames_per_second: float = 25.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if not frames_per_second > 0:
            raise UserError(
                f"{frames_per_second} frames a second cannot be replayed.",
                "Pass a positive rate; the paper's is 25.",
            )
        self.counts: Counter[str] = Counter()
        self._dataset, self._clock, self._sleep = dataset, clock, sleep
        # A dataset may list its frames in any order; a film has one.
        self._train = sorted(dataset.train, key=dataset.frame_index.__getitem__)
        self._position = {number: place for place, number in enumerate(dataset.frame_index)}
        self._interval_s = 1.0 / frames_per_second
        self._first = self._next = 0
        self._began_s: float | None = None
        self._closed = False

    def subject(self, timeout_s: float) -> StreamSubject:
        """The dataset's subject, at once."""
        data = self._dataset
        return StreamSubject(data.arrays, data.identity, data.layout, data.width, data.height)

    @property
    def ended(self) -> bool:
        """Whether all training frames have been given."""
        return self._closed or self._next >= len(self._train)

    def next(self, timeout_s: float) -> StreamedFrame | None:
        """The next frame when its time has come."""
        if self.ended:
            return None
        now = self._clock()
        if self._began_s is None:
            self._began_s = now
        due = self._began_s + (self._next - self._first) * self._interval_s
        if due > now:
            self._sleep(min(due - now, timeout_s))
            if due > now + timeout_s:
                return None
        position = self._train[self._next]
        self._next += 1
        return self._frame(position, due)

    def again(self, index: int) -> StreamedFrame:
        """The frame with this number, arrived now; raises UserError where there is none."""
        if index not in self._position:
            raise UserError(
                f"The dataset {self._dataset.root} has no frame {index}.",
                "Resume with the dataset that the run was started with.",
            )
        return self._frame(self._position[index], self._clock())

    def go_on_after(self, index: int) -> None:
        """Begin behind the frame with this number."""
        numbers = [self._dataset.frame_index[position] for position in self._train]
        self._first = self._next = bisect.bisect_right(numbers, index)

    def close(self) -> None:
        """Give no more frames."""
        self._closed = True

    def _frame(self, position: int, arrived_s: float) -> StreamedFrame:
        data = self._dataset
        path = data.image_paths[position]
        try:
            png = path.read_bytes()
        except OSError as error:
            raise UserError(
                f"The image {path} cannot be read: {error.strerror}.",
                "Copy or export the file again.",
            ) from None
        camera = data.cameras.select([position])
        index = data.frame_index[position]
        theta, marks = data.theta[position], data.marks_unfilmed
        return StreamedFrame(index, theta, camera, arrived_s, png=png, marks_unfilmed=marks)
