"""How fast an avatar is drawn here, from theta to the picture."""

import copy
import statistics
import time
from collections.abc import Callable

import torch

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.kernels import available_backends

_WARM_UP = 5
_MOST = 100


@torch.no_grad()
def frames_per_second(
    avatar: AvatarMethod, dataset: TrackedDataset, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Pictures a second, one by one, by the median over up to 100 held-out frames.

    Animation and rendering (paper, table on performance): mesh, weights, blending, picture. On a
    GPU where there is a backend for it. Training frames where none are held out.
    """
    gpu = torch.cuda.is_available() and "cuda" in available_backends()
    device = torch.device("cuda" if gpu else "cpu")
    frames = list(dataset.test or dataset.train)
    frames = frames[:: -(-len(frames) // _MOST)]
    avatar = copy.deepcopy(avatar).to(device)
    theta, cameras = dataset.theta.to(device), dataset.cameras.to(device)
    seconds = []
    for frame in [*(frames * _WARM_UP)[:_WARM_UP], *frames]:
        camera = cameras.select([frame])
        _wait_for(device)
        began = clock()
        avatar.render(theta[frame : frame + 1], camera)
        _wait_for(device)
        seconds.append(clock() - began)
    return 1 / statistics.median(seconds[_WARM_UP:])


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
