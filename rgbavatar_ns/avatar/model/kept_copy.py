"""What is made of an avatar's tensors for pictures, as long as they do not change."""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

from torch import Tensor, nn

from rgbavatar_ns.kernels import MorphedGaussians, PackedGaussians, Posing

Made = TypeVar("Made")


class KeptCopy(Generic[Made]):
    """Makes a copy when it is asked for a second time and no tensor has changed since.

    So what is trained is never copied between two steps. A copy of this is empty.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._state: tuple[object, ...] = ()
        self._made: Made | None = None

    def of(
        self, tensors: Iterable[Tensor], key: object, make: Callable[[], Made | None]
    ) -> Made | None:
        """What `make` gives for these tensors and this key; None the first time they are there.

        And where `make` has none, or torch cannot tell whether a tensor has changed.
        """
        tensors = list(tensors)
        try:
            # What a tensor is and whether it changed; the tensors themselves are kept, so that no
            # other can take their memory meanwhile.
            versions = [x for t in tensors for x in (id(t), t.data_ptr(), t._version)]
        except RuntimeError:  # inference tensors do not count their changes
            return None
        state = (key, versions, tensors)
        with self._lock:
            if state[:2] != self._state[:2]:
                self._state, self._made = state, None
            elif self._made is None:
                self._made = make()
            return self._made

    def __deepcopy__(self, memo: object) -> "KeptCopy[Made]":
        """Begin anew: a copy's tensors are others."""
        return KeptCopy()


def own_tensors(modules: Iterable[nn.Module]) -> list[Tensor]:
    """The parameters and buffers of these modules, without those of modules inside."""
    return [
        tensor
        for module in modules
        for tensors in (module._parameters, module._buffers)
        for tensor in tensors.values()
        if tensor is not None
    ]


@dataclass(frozen=True)
class PictureCopy:
    """What one picture after another is drawn from: Gaussians and what poses them."""

    gaussians: MorphedGaussians
    packed: PackedGaussians
    posing: Posing | None
