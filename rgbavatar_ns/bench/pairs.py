"""How many (pixel, Gaussian) pairs a workload has: the unit of a rasterizer's work."""

import torch

from rgbavatar_ns.bench.projection import one_camera, one_image, project, row_spans, visible_index
from rgbavatar_ns.kernels import GaussianSet, PinholeCameras


@torch.no_grad()
def count_pairs(gaussians: GaussianSet, cameras: PinholeCameras) -> int:
    """Pairs with alpha >= 1/255 over all images of the batch, counted in float64.

    Pairs behind an opaque surface count too, although a rasterizer may stop before them. Cameras
    and attributes have a leading dimension of B or 1.
    """
    exact = {"device": "cpu", "dtype": torch.float64}
    values = {name: value.to(**exact) for name, value in vars(gaussians).items()}
    gaussians = GaussianSet(**values)
    cameras = PinholeCameras(
        cameras.world_to_camera.to(**exact),
        cameras.focal_px.to(**exact),
        cameras.principal_point_px.to(**exact),
        cameras.width,
        cameras.height,
    )
    leading = [len(value) for value in vars(gaussians).values()]
    total = 0
    for position in range(max(*leading, len(cameras.focal_px))):
        single, camera = one_image(gaussians, position), one_camera(cameras, position)
        projected = project(single, camera, visible_index(single, camera))
        for spans in row_spans(projected, camera.width, camera.height):
            total += int((spans.last - spans.first + 1).sum())
    return total
