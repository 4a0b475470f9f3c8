"""What is made of an avatar's tensors for pictures, as long as they do not change."""

import threading
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from torch import Tensor

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
        if any(tensor.is_inference() for tensor in tensors):
            return None
        # The tensors themselves are kept, so that no other can take their memory meanwhile.
        versions = [(id(tensor), tensor.data_ptr(), tensor._version) for tensor in tensors]
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
