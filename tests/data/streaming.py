"""Streams of small frames for tests: the frames say who they are by their pixels."""

import contextlib
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import torch

from rgbavatar_ns.data import TrackedFrame
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.data.streams import SocketStream, StreamClient, StreamedFrame, StreamSubject
from rgbavatar_ns.head import HeadModel
from tests.data.small_dataset import CAMERA_PARTS, HEIGHT, WIDTH, frame, odd_camera

HEAD = HeadModel.embedded()
DEADLINE_S = 60.0
Opener = Callable[..., SocketStream]


class Clock:
    """Time that passes only when it is told to."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


def subject(session: str = "", width: int = WIDTH, height: int = HEIGHT) -> StreamSubject:
    identity = torch.linspace(-1, 1, HEAD.num_identity) / 3
    return StreamSubject(HEAD.arrays, identity, HEAD.layout, width, height, session)


def tracked(index: int) -> TrackedFrame:
    return frame(HEAD, index, per_frame_camera=True)


def streamed(
    index: int,
    session: str = "",
    image: np.ndarray | None = None,
    arrived_s: float = 0.0,
    encode: bool = True,
) -> StreamedFrame:
    one = tracked(index)
    rgba = one.image_rgba if image is None else image
    kind = {"png": encode_png_rgba(rgba)} if encode else {"image_rgba": rgba}
    return StreamedFrame(index, one.theta, one.camera, arrived_s, session, **kind)


def cheap(index: int) -> StreamedFrame:
    """A frame whose making costs next to nothing."""
    theta = torch.full((HEAD.layout.size,), float(index))
    image = np.full((HEIGHT, WIDTH, 4), index % 251, np.uint8)
    return StreamedFrame(index, theta, odd_camera(), 0.0, image_rgba=image)


class GivenStream:
    """Gives what it was made with, then ends."""

    def __init__(self, frames: Iterable[StreamedFrame], keeps_frames: bool = False) -> None:
        self.counts: Counter[str] = Counter()
        self.keeps_frames = keeps_frames
        self._frames = deque(frames)
        self.closed = False

    def subject(self, timeout_s: float) -> StreamSubject | None:
        return subject()

    @property
    def ended(self) -> bool:
        return not self._frames

    def next(self, timeout_s: float) -> StreamedFrame | None:
        return self._frames.popleft() if self._frames else None

    def close(self) -> None:
        self.closed = True


def take(stream, count: int) -> list[StreamedFrame]:
    """The next `count` frames of a stream, or fewer if it ends before."""
    frames, deadline = [], time.monotonic() + DEADLINE_S
    while len(frames) < count and not stream.ended:
        assert time.monotonic() < deadline, f"only {len(frames)} of {count} frames came"
        one = stream.next(0.05)
        if one is not None:
            frames.append(one)
    return frames


def until(condition) -> None:
    """Wait for what another thread does."""
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def same(sent: TrackedFrame, got: StreamedFrame) -> bool:
    """Whether a frame came through bit for bit."""
    image = got.decode().image_rgba
    return (
        sent.index == got.index
        and torch.equal(sent.theta, got.theta)
        and all(torch.equal(getattr(sent.camera, p), getattr(got.camera, p)) for p in CAMERA_PARTS)
        and np.array_equal(sent.image_rgba, image)
    )


@contextlib.contextmanager
def sending(session: str, address: str, frames: range) -> Iterator[None]:
    """While a client sends frames and ends its stream."""

    def send() -> None:
        with StreamClient(subject(session), address) as client:
            for index in frames:
                client.send(tracked(index))

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    yield
    sender.join(DEADLINE_S)
    assert not sender.is_alive()


def indices(stream: SocketStream, count: int) -> list[int]:
    return [frame.index for frame in take(stream, count)]
