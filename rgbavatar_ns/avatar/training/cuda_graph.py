"""Work on a device that is recorded once and repeated without the host."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.kernels import DeviceRenderer, PinholeCameras

Recorder = Callable[[Callable[[], None]], Callable[[], None]]
"""Turns work into what repeats it."""


def record_cuda_graph(work: Callable[[], None]) -> Callable[[], None]:
    """Record the kernels that `work` starts and return what starts them all at once."""
    graph = torch.cuda.CUDAGraph()
    # Other threads, such as a viewer's, may use the device meanwhile.
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        work()
    return graph.replay


def supports(
    avatar: Avatar, theta: Float[Tensor, "1 H"], cameras: PinholeCameras, backend: str = "auto"
) -> bool:
    """Whether steps of this avatar on theta's device can do without the host."""
    return isinstance(avatar.renderer(theta, cameras, backend=backend), DeviceRenderer)
