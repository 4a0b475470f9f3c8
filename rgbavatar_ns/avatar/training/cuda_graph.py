"""Work on a device that is recorded once and repeated without the host."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.kernels import DeviceRenderer, PinholeCameras

Recorder = Callable[[Callable[[], None]], Callable[[], None]]
"""Turns work into what repeats it."""


def record_cuda_graph(work: Callable[[], None]) -> Callable[[], None]:
    """Record the kernels that `work` starts and return what starts them all at once.

    To be called in a `lane`: a device's first stream cannot be recorded.
    """
    graph = torch.cuda.CUDAGraph()
    # Other threads, such as a viewer's, may use the device meanwhile.
    stream = torch.cuda.current_stream()
    with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
        work()
    return graph.replay


def lane(device: torch.device) -> Callable[[], AbstractContextManager[None]]:
    """A stream of a device's own for what is warmed up, recorded and repeated, to be entered.

    What is started within comes after all that was started before, and before all that follows.
    The device becomes the current one. On a CPU it is nothing.
    """
    if device.type != "cuda":
        return nullcontext
    stream = torch.cuda.Stream(device)

    @contextmanager
    def entered() -> Iterator[None]:
        with torch.cuda.device(device):
            around = torch.cuda.current_stream(device)
            stream.wait_stream(around)
            try:
                with torch.cuda.stream(stream):
                    yield
            finally:
                around.wait_stream(stream)

    return entered


class Recording:
    """Work of an avatar that is recorded once, and anew where what it reads lies elsewhere.

    A recording names places in memory: those of parameters, of buffers, of what the head remembers
    of its person and of what `also` gives. They are held, so that no other tensor takes a place,
    and compared before the work is repeated.

    Args:
        avatar: what the work draws or trains.
        work: starts kernels, and waits for nothing.
        recorder: turns it into what repeats it.
        also: the other tensors that it reads and does not own.
    """

    def __init__(
        self,
        avatar: Avatar,
        work: Callable[[], None],
        recorder: Recorder,
        also: Callable[[], Iterable[Tensor]] = tuple,
    ) -> None:
        self._avatar, self._work, self._recorder, self._also = avatar, work, recorder, also
        self._replay: Callable[[], None] | None = None
        self._held: list[Tensor] = []

    def __call__(self) -> None:
        """Do the work."""
        avatar = self._avatar
        # What the head remembers must not be made within a recording, whose memory is its own.
        remembered = avatar.head.remembered(avatar.identity)
        read = [*avatar.parameters(), *avatar.buffers(), *remembered, *self._also()]
        if self._replay is None or list(map(_place, read)) != list(map(_place, self._held)):
            self._replay = self._recorder(self._work)
            self._held = [tensor.detach() for tensor in read]
        self._replay()

    def forget(self) -> None:
        """Record it anew the next time."""
        self._replay = None


def _place(tensor: Tensor) -> tuple[int, torch.Size]:
    return tensor.data_ptr(), tensor.shape


def supports(
    avatar: Avatar, theta: Float[Tensor, "1 H"], cameras: PinholeCameras, backend: str = "auto"
) -> bool:
    """Whether steps of this avatar on theta's device can do without the host."""
    return isinstance(avatar.renderer(theta, cameras, backend=backend), DeviceRenderer)
