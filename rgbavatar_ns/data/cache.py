"""Decoded images within a byte budget, decoded ahead by background threads."""

import threading
import weakref
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

Image = UInt8[np.ndarray, "height width 4"]


@runtime_checkable
class ImageSource(Protocol):
    """Where images of one size come from: a `TrackedDataset`."""

    @property
    def width(self) -> int:
        """Of every image, in pixels."""
        ...

    @property
    def height(self) -> int:
        """Of every image, in pixels."""
        ...

    def read_image(self, position: int) -> Image:
        """Decode one image; called from background threads."""
        ...


class ImageCache:
    """Images of a dataset as uint8, as many as the budget allows.

    Where they are more, the one that was read last gives way: training shows every frame once an
    epoch, so that one comes again latest. Of a film that is twice too long half the images stay;
    where the least recently used gave way, nearly all would be decoded anew each time.

    Safe to use from several threads. A batch that `get` hands out is the caller's own and does
    not count; everything the cache holds, images still being decoded included, does.
    """

    def __init__(self, dataset: ImageSource, budget_bytes: int, num_workers: int = 2) -> None:
        self._read = dataset.read_image
        self._image_bytes = dataset.width * dataset.height * 4
        self._capacity = max(0, budget_bytes // self._image_bytes)
        self._lock = threading.Lock()
        self._images: OrderedDict[int, Future[Image]] = OrderedDict()
        self._unread: set[int] = set()
        self._workers = ThreadPoolExecutor(max(1, num_workers), "decode")
        # Threads end with the cache, and what nobody waits for any more is not decoded.
        self._closer = weakref.finalize(
            self, self._workers.shutdown, wait=False, cancel_futures=True
        )

    @property
    def held_bytes(self) -> int:
        """Bytes of the images held now, those still being decoded included."""
        return len(self._images) * self._image_bytes

    def get(self, positions: Sequence[int]) -> UInt8[Tensor, "B height width 4"]:
        """Return these frames' images as one new tensor; raises what a decoding thread raised."""
        with self._lock:
            waited_for = [self._request(position) for position in positions]
        try:
            images = [future.result() for future in waited_for]
        except BaseException:
            with self._lock:
                self._forget_failures()
            raise
        return torch.from_numpy(np.stack(images))

    def prefetch(self, positions: Sequence[int]) -> None:
        """Begin to decode these frames, as far as room can be made, and return at once.

        Images that were asked for ahead and not read yet are never given up for others.
        """
        with self._lock:
            for position in positions:
                if position in self._images:
                    continue
                if not self._make_room(keep_unread=True):
                    return
                self._images[position] = self._workers.submit(self._read, position)
                self._unread.add(position)

    def close(self) -> None:
        """Stop the background threads; the cache cannot be used afterwards."""
        self._closer()

    def _request(self, position: int) -> "Future[Image]":
        self._unread.discard(position)
        future = self._images.get(position)
        if future is not None:
            self._images.move_to_end(position)
            return future
        future = self._workers.submit(self._read, position)
        if self._make_room(keep_unread=False):
            self._images[position] = future
        return future

    def _make_room(self, keep_unread: bool) -> bool:
        """Give up the image that was read last where the budget is full; say if one more fits."""
        if len(self._images) < self._capacity:
            return True
        newest_first = reversed(self._images)
        given_up = next((p for p in newest_first if p not in self._unread), None)
        if given_up is None:
            if keep_unread or not self._images:
                return False
            given_up = next(reversed(self._images))
        dropped = self._images.pop(given_up)
        if given_up in self._unread:  # else somebody may be waiting for it
            dropped.cancel()
            self._unread.discard(given_up)
        return True

    def _forget_failures(self) -> None:
        for position, future in list(self._images.items()):
            if future.cancelled() or (future.done() and future.exception() is not None):
                del self._images[position]
                self._unread.discard(position)
