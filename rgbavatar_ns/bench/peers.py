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

from rgbavatar_ns.bench.dense_torch import dense_torch
from rgbavatar_ns.bench.drawing import Draw, DrawTimes, time_draw
from rgbavatar_ns.bench.gsplat_torch import gsplat_torch
from rgbavatar_ns.bench.projection import one_camera, one_image
from rgbavatar_ns.bench.timing import Stopwatch
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras

Adapter = Callable[[GaussianSet, PinholeCameras], Draw]


def _dense_torch(gaussians: GaussianSet, cameras: PinholeCameras) -> Draw:
    return lambda gaussians: dense_torch(gaussians, cameras)


PEERS: dict[str, Adapter] = {"dense torch": _dense_torch, "gsplat torch": gsplat_torch}


def time_peers(
    ours: Adapter,
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
    shape = (1, camera.height, camera.width, 3)
    own_draw = ours(single, camera)
    with torch.no_grad():
        own_image = own_draw(single)
    own = time_draw("ours, one image", own_draw, single, shape, stopwatch)
    results: dict[str, Any] = {}
    for name, adapter in (PEERS if peers is None else peers).items():
        try:
            draw = adapter(single, camera)
            with torch.no_grad():
                difference = (draw(single) - own_image).abs()
            times = time_draw(f"peer: {name}", draw, single, shape, stopwatch)
        except (ImportError, RuntimeError, AttributeError, OSError) as error:
            reason = (str(error).splitlines() or [""])[0]
            results[name] = {"unavailable": f"{type(error).__name__}: {reason}"}
            continue
        results[name] = {
            **_figures(times),
            "ratio": times.whole.median_ms / ours_ms_per_image,
            "ratio_one_image": times.whole.median_ms / own.whole.median_ms,
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


def _figures(times: DrawTimes) -> dict[str, float | int | None]:
    """One image's."""
    return {
        "forward_ms_per_image": times.forward.median_ms,
        "backward_ms_per_image": times.backward.median_ms,
        "whole_ms_per_image": times.whole.median_ms,
        "bytes_per_image": times.growth_bytes,
    }
