"""From a stream to the pools, beside the training and never in its way."""

import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from rgbavatar_ns.data.streams.protocol import (
    Fault,
    FrameStream,
    Rewindable,
    StreamedFrame,
    StreamSubject,
)
from rgbavatar_ns.data.streams.replay_buffer import ReplayBuffer
from rgbavatar_ns.data.streams.sequence_numbers import SeenNumbers
from rgbavatar_ns.errors import UserError

_PATIENCE_S = 0.1


class FrameQueue:
    """Frames between source and decoder; when full, `put` drops the oldest one, or waits."""

    def __init__(self, capacity: int) -> None:
        self.dropped = 0
        self._frames: deque[StreamedFrame] = deque(maxlen=capacity)
        self._closed = False
        self._changed = threading.Condition()

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: StreamedFrame, wait: bool) -> None:
        """Append a frame; does nothing once the queue is closed."""
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: self._closed or not self._is_full())
            if not self._closed:
                self.dropped += self._is_full()
                self._frames.append(frame)
                self._changed.notify_all()

    def _is_full(self) -> bool:
        return len(self._frames) == self._frames.maxlen

    def get(self) -> StreamedFrame | None:
        """Take the oldest frame, waiting for one; None once the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._frames)
            frame = self._frames.popleft() if self._frames else None
            self._changed.notify_all()
            return frame

    def close(self) -> None:
        """Let nothing more in; what is there can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Ingest:
    """Two threads: one listens to the stream, one checks and decodes frames and fills the pools.

    Frames that cannot be used are left out and counted. At most `queue_frames` wait to be decoded;
    `tell` is called, from the threads, with what a user should read at once.
    """

    def __init__(
        self,
        stream: FrameStream,
        subject: StreamSubject,
        pools: ReplayBuffer,
        queue_frames: int = 256,
        tell: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._stream, self._subject, self._pools, self._tell = stream, subject, pools, tell
        self._queue = FrameQueue(queue_frames)
        self._counts: Counter[str] = Counter()
        self._seen = SeenNumbers()
        self._session = subject.session
        self._between_frames = threading.Lock()
        self._stopped = threading.Event()
        self._threads: list[threading.Thread] = []
        self._finished = threading.Event()
        self.failure: Exception | None = None
        """What ended the stream against its will; to be raised by who looks after the threads."""
        self.goes_on = False
        """Whether a resumed stream is the one that was left, and goes on where it was."""

    @property
    def finished(self) -> bool:
        """Whether the stream has ended and all its frames have been dealt with."""
        return self._finished.is_set()

    def counts(self) -> Counter[str]:
        """Frames "arrived" and "taken in", and what went wrong, by name."""
        counts = self._counts.copy() + self._stream.counts
        counts["arrived"] += 0
        counts["taken in"] += 0
        counts["dropped"] = self._queue.dropped
        return counts

    def listen(self) -> None:
        """Begin to take frames from the stream, as far as the queue goes."""
        self._begin("rgbavatar stream", self._listen)

    def give(self, frame: StreamedFrame) -> None:
        """Take a frame as if the stream had just given it."""
        self._counts["arrived"] += 1
        self._queue.put(frame, wait=self._stream.keeps_frames)

    def count_left_out(self, counts: Counter[str]) -> None:
        """Count frames, by their reasons, that were left out before the first one was given."""
        self._counts += counts
        self._counts["arrived"] += counts.total()

    def start(self) -> None:
        """Begin to fill the pools, and to listen where that has not begun."""
        if not self._threads:
            self.listen()
        self._begin("rgbavatar ingest", self._fill)

    def close(self) -> None:
        """Stop both threads and close the stream."""
        self._stopped.set()
        self._queue.close()
        self._stream.close()
        for thread in self._threads:
            thread.join(timeout=5.0)

    def _begin(self, name: str, work: Callable[[], None]) -> None:
        def guarded() -> None:
            try:
                work()
            except Exception as error:
                if not self._stopped.is_set():
                    self.failure = error
            finally:
                self._queue.close()

        thread = threading.Thread(target=guarded, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _listen(self) -> None:
        while not self._stopped.is_set():
            frame = self._stream.next(_PATIENCE_S)
            if frame is not None:
                self.give(frame)
            elif self._stream.ended:
                return

    def _fill(self) -> None:
        while not self._stopped.is_set():
            frame = self._queue.get()
            if frame is None:
                self._finished.set()
                return
            self.take_in(frame)

    def take_in(self, frame: StreamedFrame) -> None:
        """Put one frame into the pools, or count why it is left out and tell the first such."""
        with self._between_frames:
            verdict = self._number(frame)
            if verdict is None:
                fault = self._subject.fault(frame) or self._added(frame)
                verdict = "taken in" if fault is None else fault.name
                if fault is not None and not self._counts[verdict]:
                    self._tell(fault.told(frame))
            self._counts[verdict] += 1

    def _number(self, frame: StreamedFrame) -> str | None:
        """Note the frame's number; why the frame is left out for it, or None."""
        if frame.session != self._session:
            self._session, self._seen = frame.session, SeenNumbers()
        verdict = self._seen.add(frame.index)
        self._counts["out of order"] += verdict == "late"
        return verdict if verdict == "duplicate" else None

    def _added(self, frame: StreamedFrame) -> Fault | None:
        try:
            self._pools.add(frame)
        except UserError as error:
            return Fault.unreadable(error)
        return None

    def state_dict(self) -> dict[str, Any]:
        """Counters, frame numbers and pools, safe for `torch.load(weights_only=True)`."""
        with self._between_frames:
            counts = self.counts()
            counts["arrived"] -= len(self._queue)
            state = {
                "counts": dict(counts),
                "numbers": self._seen.state_dict(),
                "session": self._session,
            }
            frames = self._pools.snapshot()
        # Images are encoded here; meanwhile more may come in.
        return state | {"frames": frames()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken; before `start`, and before `listen` if it can be."""
        self._pools.load_state_dict(state["frames"], self._stream)
        # What has arrived already, for a run that goes on, came after what the state counts.
        self._counts = self._counts + Counter(state["counts"])
        self._queue.dropped = self._counts.pop("dropped", 0)
        self._session = state["session"]
        self._seen.load_state_dict(state["numbers"])
        # Earlier checkpoints of films know no session.
        known = self._session in ("", self._subject.session)
        if known and isinstance(self._stream, Rewindable):
            self.goes_on = True
            self._stream.go_on_after(self._seen.newest)
