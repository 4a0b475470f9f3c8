"""Other rasterizers, drawing the same picture in the same process.

A peer is an adapter: given one image's Gaussians and its camera, it returns a function that draws
them, differentiable in every attribute, over black. What the adapter does before it returns is
not timed. To add one, here or in a program of your own:

    from rgbavatar_ns.bench.peers import PEERS

    def mine(gaussians, cameras):
        import my_rasterizer                      # an ImportError is shown as the reason

        focal, centre = cameras.focal_px[0], cameras.principal_point_px[0]

        def draw(gaussians):                      # leading dimensions are all 1
            splats = [value[0] for value in vars(gaussians).values()]
            return my_rasterizer.draw(*splats, cameras.world_to_camera[0], focal, centre)[None]

        return draw

    PEERS["mine"] = mine
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.bench.dense_torch import dense_torch
from rgbavatar_ns.bench.gsplat_torch import gsplat_torch
from rgbavatar_ns.bench.projection import one_camera, one_image
from rgbavatar_ns.bench.timing import WHOLE, Lap, Stopwatch, peak_growth_bytes
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras

Draw = Callable[[GaussianSet], Float[Tensor, "1 H W 3"]]
Adapter = Callable[[GaussianSet, PinholeCameras], Draw]


def _dense_torch(gaussians: GaussianSet, cameras: PinholeCameras) -> Draw:
    return lambda gaussians: dense_torch(gaussians, cameras)


PEERS: dict[str, Adapter] = {"dense torch": _dense_torch, "gsplat torch": gsplat_torch}


def time_peers(
    ours: Draw,
    gaussians: GaussianSet,
    cameras: PinholeCameras,
    ours_ms_per_image: float,
    stopwatch: Stopwatch,
    peers: Mapping[str, Adapter] | None = None,
) -> dict[str, Any]:
    """Each peer's figures on the batch's first image, or {"unavailable": reason}.

    `ratio` is the peer's forward and backward over `ours_ms_per_image`, ours in the whole batch;
    `ratio_one_image` is over ours given the same single image.
    """
    single, camera = one_image(gaussians, 0), one_camera(cameras, 0)
    with torch.no_grad():
        image = ours(single)
    own = time_draw("ours, one image", ours, single, stopwatch)
    results: dict[str, Any] = {}
    for name, adapter in (PEERS if peers is None else peers).items():
        try:
            draw = adapter(single, camera)
            with torch.no_grad():
                difference = (draw(single) - image).abs()
            figures = time_draw(f"peer: {name}", draw, single, stopwatch)
        except (ImportError, RuntimeError, AttributeError, OSError) as error:
            reason = (str(error).splitlines() or [""])[0]
            results[name] = {"unavailable": f"{type(error).__name__}: {reason}"}
            continue
        whole = figures["forward_ms_per_image"] + figures["backward_ms_per_image"]
        own_whole = own["forward_ms_per_image"] + own["backward_ms_per_image"]
        results[name] = {
            **figures,
            "ratio": whole / ours_ms_per_image,
            "ratio_one_image": whole / own_whole,
            "mean_difference": float(difference.mean()),
            "largest_difference": float(difference.max()),
            "images": 1,
            "gaussians": single.means.shape[1],
            "width_px": camera.width,
            "height_px": camera.height,
            "threads": torch.get_num_threads(),
            "repetitions": stopwatch.repetitions,
        }
    return results


def time_draw(
    what: str, draw: Draw, gaussians: GaussianSet, stopwatch: Stopwatch
) -> dict[str, float | int | None]:
    """Forward and backward in milliseconds an image, and the memory that both need."""
    leaves = leaf_gaussians(gaussians)
    with torch.no_grad():
        image_grad = torch.randn_like(draw(leaves)) / draw(leaves)[0].numel()

    def once(lap: Lap) -> None:
        for leaf in vars(leaves).values():
            leaf.grad = None
        image = draw(leaves)
        lap("forward")
        image.backward(image_grad)
        lap("backward")

    memory = peak_growth_bytes(lambda: once(lambda name: None))
    spread = stopwatch.laps(what, once)
    return {
        "forward_ms_per_image": spread["forward"].median_ms / len(image_grad),
        "backward_ms_per_image": spread["backward"].median_ms / len(image_grad),
        "forward_backward_ms_per_image": spread[WHOLE].median_ms / len(image_grad),
        "bytes_per_image": None if memory is None else memory // len(image_grad),
    }


def leaf_gaussians(gaussians: GaussianSet) -> GaussianSet:
    """The same Gaussians as leaves that ask for gradients."""
    return GaussianSet(
        **{name: value.detach().requires_grad_() for name, value in vars(gaussians).items()}
    )
