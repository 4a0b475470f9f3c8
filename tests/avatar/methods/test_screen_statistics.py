"""What density control sums up between two changes."""

import math

import torch

from rgbavatar_ns.avatar.method import WatchedStep
from rgbavatar_ns.avatar.methods.density import ScreenStatistics
from tests.kernels.scenes import random_scene


def test_the_gradient_is_that_of_one_images_loss_in_normalised_coordinates():
    batch, count, width, height = 3, 7, 64, 48
    generator = torch.Generator().manual_seed(0)
    ndc = torch.rand(batch, count, 2, generator=generator, dtype=torch.float64) * 2 - 1
    targets = torch.rand(batch, count, 2, generator=generator, dtype=torch.float64)
    side = torch.tensor([width, height], dtype=torch.float64)

    def losses(place_px: torch.Tensor) -> torch.Tensor:
        return ((place_px / side - targets) ** 3).sum((1, 2))

    place_px = ((ndc + 1) / 2 * side).requires_grad_()
    losses(place_px).mean().backward()
    statistics = ScreenStatistics(count).double()
    statistics.add(place_px.grad, width, height)

    expected = torch.zeros(count, dtype=torch.float64)
    for image in range(batch):
        alone = ndc[image : image + 1].clone().requires_grad_()
        # Only this image's loss counts, as where steps are taken on one image.
        losses(((alone + 1) / 2 * side).expand(batch, -1, -1))[image].backward()
        expected += alone.grad[0].norm(dim=-1)
    torch.testing.assert_close(statistics.gradient_sum, expected)
    torch.testing.assert_close(statistics.mean_gradient(), expected / batch)


def test_a_batch_counts_as_its_images_one_by_one():
    gradient = torch.randn(4, 6, 2, generator=torch.Generator().manual_seed(0))
    gradient[1, 2] = 0
    gradient[:, 5] = 0
    together, alone = ScreenStatistics(6), ScreenStatistics(6)
    together.add(gradient / 4, 30, 20)  # of the mean over four
    for image in gradient:
        alone.add(image[None], 30, 20)
    torch.testing.assert_close(together.gradient_sum, alone.gradient_sum)
    assert together.times_seen.tolist() == alone.times_seen.tolist() == [4, 4, 3, 4, 4, 0]
    assert together.mean_gradient()[5] == 0


def test_what_counts_as_seen_may_be_told():
    gradient = torch.ones(2, 3, 2)
    drawn = torch.tensor([[True, False, True], [True, False, False]])
    statistics = ScreenStatistics(3)
    statistics.add(gradient, 2, 2, drawn)
    assert statistics.times_seen.tolist() == [2, 0, 1]
    torch.testing.assert_close(
        statistics.gradient_sum, 2 * math.sqrt(2) * torch.tensor([2.0, 0.0, 1.0])
    )
    statistics.begin(4)
    assert statistics.mean_gradient().tolist() == [0, 0, 0, 0]


def test_a_watched_step_counts_what_is_in_its_pictures_drawn_or_hidden():
    scene = random_scene(3, batch=2, count=50, num_cameras=2)
    cameras, generator = scene.cameras, torch.Generator().manual_seed(0)
    gradient = torch.randn(2, 50, 2, generator=generator, dtype=scene.gaussians.means.dtype)
    gradient[:, :5] = 0  # hidden by others
    found, wanted = ScreenStatistics(50), ScreenStatistics(50)
    found.add_step(WatchedStep(scene.gaussians, cameras, gradient))
    seen = cameras.shows(scene.gaussians.means)
    wanted.add(gradient, cameras.width, cameras.height, seen)
    assert torch.equal(found.times_seen, seen.sum(0))
    assert found.times_seen[:5].any()
    torch.testing.assert_close(found.gradient_sum, wanted.gradient_sum)
