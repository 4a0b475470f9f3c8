import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing

import numpy as np
import pytest
import torch

from rgbavatar_ns.data import ImageCache, OfflineOrder
from rgbavatar_ns.errors import UserError
from tests.data.small_dataset import HEIGHT, WIDTH, noise_image, small_dataset
from tests.data.streaming import until

IMAGE_BYTES = WIDTH * HEIGHT * 4


class CountingDataset:
    """Stands in for a dataset: counts what is decoded and can hold the workers up."""

    width, height = WIDTH, HEIGHT

    def __init__(self, failing: int | None = None) -> None:
        self.reads: list[int] = []
        self.failing = failing
        self.may_go_on = threading.Event()
        self.may_go_on.set()

    def read_image(self, position: int) -> np.ndarray:
        self.may_go_on.wait(10)
        self.reads.append(position)
        if position == self.failing:
            raise UserError(f"The image {position}.png is truncated.", "Repair it.")
        return noise_image(position)


@pytest.fixture
def make_cache():
    with ExitStack() as opened:

        def make(dataset, images: float, workers: int = 2) -> ImageCache:
            cache = ImageCache(dataset, int(images * IMAGE_BYTES), workers)
            return opened.enter_context(closing(cache))

        yield make


def test_images_come_in_the_order_asked_for(tmp_path, head, make_cache):
    dataset = small_dataset(tmp_path, head)
    cache = make_cache(dataset, 100)
    images = cache.get([3, 0, 3])
    assert images.shape == (3, HEIGHT, WIDTH, 4)
    assert images.dtype == torch.uint8
    for image, index in zip(images, (3, 0, 3)):
        assert np.array_equal(image.numpy(), noise_image(index))


def test_what_was_read_last_gives_way(make_cache):
    dataset = CountingDataset()
    cache = make_cache(dataset, 2)
    for position in (0, 1, 2, 0):
        cache.get([position])
    assert dataset.reads == [0, 1, 2]
    cache.get([1])
    assert dataset.reads == [0, 1, 2, 1]


@pytest.mark.parametrize("kept", [0.25, 0.5, 0.8])
def test_of_a_film_beyond_the_budget_what_fits_is_not_decoded_again(make_cache, kept):
    """Over epochs that show every frame once, in an order of their own, as training has them."""
    frames, epochs, ahead = 200, 6, 2
    dataset, order = CountingDataset(), OfflineOrder(range(frames), 10, seed=0)
    cache = make_cache(dataset, kept * frames)
    steps = frames * epochs // 10
    for step in range(steps):
        cache.get(order.batch(step))
        for later in range(step + 1, min(step + 1 + ahead, steps)):
            cache.prefetch(order.batch(later))
    anew = (len(dataset.reads) - frames) / (frames * (epochs - 1))
    # Frames on their way and the border of two epochs cost a little.
    assert anew < 1 - kept + 0.1


@pytest.mark.parametrize("images", [0, 0.9, 1, 2.5, 4])
def test_the_budget_holds_at_every_moment(make_cache, images):
    cache = make_cache(CountingDataset(), images)
    rng = np.random.default_rng(0)
    for _ in range(60):
        cache.prefetch(rng.integers(0, 9, 3).tolist())
        assert cache.held_bytes <= images * IMAGE_BYTES
        wanted = rng.integers(0, 9, 3).tolist()
        got = cache.get(wanted)
        assert cache.held_bytes <= images * IMAGE_BYTES
        for image, index in zip(got, wanted):
            assert np.array_equal(image.numpy(), noise_image(index))


def test_prefetching_decodes_in_the_background(make_cache):
    dataset = CountingDataset()
    dataset.may_go_on.clear()
    cache = make_cache(dataset, 10)
    cache.prefetch([4, 5, 6])  # returns although no image can be decoded yet
    assert dataset.reads == []
    dataset.may_go_on.set()
    until(lambda: sorted(dataset.reads) == [4, 5, 6])
    cache.get([4, 5, 6])
    assert len(dataset.reads) == 3


def test_images_asked_for_ahead_do_not_push_each_other_out(make_cache):
    dataset = CountingDataset()
    cache = make_cache(dataset, 3)
    cache.get([0, 1])
    cache.prefetch([2, 3, 4, 5, 6])
    until(lambda: len(dataset.reads) == 5)
    cache.get([2, 3, 4])
    assert sorted(dataset.reads) == [0, 1, 2, 3, 4]


def test_a_workers_error_is_raised_by_get_and_tried_again(make_cache):
    dataset = CountingDataset(failing=2)
    cache = make_cache(dataset, 10)
    cache.prefetch([1, 2])
    for _ in range(2):
        with pytest.raises(UserError, match=r"2\.png is truncated"):
            cache.get([1, 2])
    dataset.failing = None
    assert np.array_equal(cache.get([2])[0].numpy(), noise_image(2))


def test_several_threads_get_the_right_images(make_cache):
    cache = make_cache(CountingDataset(), 3, workers=3)

    def wrong(seed: int) -> list[int]:
        asked = np.random.default_rng(seed).integers(0, 8, 40).tolist()
        return [k for k in asked if not np.array_equal(cache.get([k])[0].numpy(), noise_image(k))]

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(wrong, range(4))) == [[]] * 4


def test_threads_end_with_the_cache():
    before = set(threading.enumerate())
    cache = ImageCache(CountingDataset(), 100 * IMAGE_BYTES)
    cache.get([0, 1])
    # Threads of other tests may end meanwhile: only this cache's own are looked at.
    started = set(threading.enumerate()) - before
    assert started
    del cache
    until(lambda: not any(thread.is_alive() for thread in started))
