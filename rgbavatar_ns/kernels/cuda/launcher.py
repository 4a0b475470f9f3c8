"""Starting kernels: on a GPU here, on an emulated one in the tests."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor


@runtime_checkable
class Launcher(Protocol):
    """Runs kernels in the order in which they are launched."""

    @property
    def device(self) -> torch.device:
        """Where the kernels' tensors must lie."""
        ...

    def launch(
        self, kernel: str, grid: Sequence[int], shared_bytes: int = 0, **values: Any
    ) -> None:
        """Start a kernel on `grid` blocks with the named values of its argument structure."""
        ...

    def read_later(self, numbers: Tensor) -> Callable[[], list[int] | None]:
        """Return a function that gives the tensor's present numbers, None while they are not here.

        Nothing waits for them.
        """
        ...

    def capturing(self) -> bool:
        """Whether launches are being recorded, so that nothing can be read."""
        ...
