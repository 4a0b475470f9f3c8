"""An avatar's Gaussians packed for pictures, as long as they do not change."""

import threading

from torch import Tensor

from rgbavatar_ns.kernels import MorphedGaussians, PackedGaussians, packed_gaussians


class PackedAvatar:
    """Packs Gaussians when they are asked for a second time and have not changed since.

    So what is trained is never packed between two steps. A copy of it is empty.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._state: tuple[object, ...] = ()
        self._packed: PackedGaussians | None = None

    def of(self, gaussians: MorphedGaussians, backend: str = "auto") -> PackedGaussians | None:
        """Their copy; None the first time, and where the backend has none or torch cannot tell."""
        tensors = [value for value in vars(gaussians).values() if isinstance(value, Tensor)]
        if any(tensor.is_inference() for tensor in tensors):
            return None
        # The tensors themselves are kept, so that no other can take their memory meanwhile.
        versions = [(id(tensor), tensor.data_ptr(), tensor._version) for tensor in tensors]
        state = (backend, gaussians.variant, versions, tensors)
        with self._lock:
            if state[:3] != self._state[:3]:
                self._state, self._packed = state, None
            elif self._packed is None:
                self._packed = packed_gaussians(gaussians, backend)
            return self._packed

    def __deepcopy__(self, memo: object) -> "PackedAvatar":
        """Begin anew: a copy's tensors are others."""
        return PackedAvatar()
