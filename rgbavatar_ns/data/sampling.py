"""Which frames a training step sees: a shuffled order offline, two pools for a stream."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from rgbavatar_ns.errors import UserError

_KEPT_EPOCHS = 4
_RAMP_FRAMES = 600
_NEWEST_FRAMES = 150.0

PoolStrategy = Literal["paper", "release"]
"""paper: a fixed share of each batch from the local pool, all of its frames equally likely.
release: as the authors' program is said to do, the global pool's share grows over the first 600
frames and local draws favour the newest, exp(i / 150) for the i-th oldest."""

DEFAULT_LOCAL_SHARE: dict[PoolStrategy, float] = {"paper": 0.7, "release": 0.3}
"""The local pool's share of a batch; for "release" that which it falls to, from 1."""


class OfflineOrder:
    """Endless batches in which every epoch shows every frame once, in an order of its own.

    A batch is a pure function of (seed, step), so that resuming needs no state. Frames of one
    batch are all different, also where the batch spans two epochs: there the next epoch's order
    gives way just enough. Ours; the paper only says that batches are drawn from all frames.
    """

    def __init__(self, positions: Sequence[int], batch_size: int, seed: int) -> None:
        if len(positions) == 0:
            raise UserError(
                "There are no frames to draw from.",
                "Use a dataset with at least one frame in each of its two parts.",
            )
        if not 1 <= batch_size <= len(positions):
            raise ValueError(
                f"A batch of {batch_size} different frames out of {len(positions)} is impossible."
            )
        self._positions = np.asarray(positions)
        self._batch_size = batch_size
        self._seed = seed
        self._orders: dict[int, npt.NDArray[np.intp]] = {}

    def batch(self, step: int) -> list[int]:
        """The frames of training step `step` (0, 1, ...)."""
        count = len(self._positions)
        epoch, first = divmod(step * self._batch_size, count)
        chosen = self._order(epoch)[first : first + self._batch_size]
        missing = self._batch_size - len(chosen)
        if missing:
            chosen = np.concatenate([chosen, self._order(epoch + 1)[:missing]])
        return self._positions[chosen].tolist()

    def _order(self, epoch: int) -> npt.NDArray[np.intp]:
        """The order of an epoch; each depends on the end of the one before it."""
        known = max((e for e in self._orders if e <= epoch), default=-1)
        for missing in range(known + 1, epoch + 1):
            self._orders[missing] = self._next_order(missing)
            for old in [e for e in self._orders if e <= missing - _KEPT_EPOCHS]:
                del self._orders[old]
        return self._orders[epoch]

    def _next_order(self, epoch: int) -> npt.NDArray[np.intp]:
        count = len(self._positions)
        # Raw bits of a bit generator and a stable sort: numpy promises both for ever, while
        # Generator.permutation may change between versions.
        bits = np.random.PCG64(np.random.SeedSequence([self._seed, epoch])).random_raw(count)
        order = np.argsort(bits, kind="stable")
        begun = (epoch * count) % self._batch_size
        if epoch == 0 or begun == 0:
            return order
        ended_with = self._orders[epoch - 1][count - begun :]
        free = np.flatnonzero(~np.isin(order, ended_with))[: self._batch_size - begun]
        return np.concatenate([order[free], np.delete(order, free)])


class LocalGlobalPools:
    """The paper's sampling of a stream: recent frames first, old ones so as not to be forgotten.

    New frames enter a local pool, first in, first out; each frame that leaves it is offered to
    a global pool by reservoir sampling, which keeps every frame of the past equally likely
    (RGBAvatar, sec. 3.3 and supplement, algorithm 2). Frames are known by their number; who
    feeds the pools keeps their images and drops what `add` returns.

    Args:
        local_size, global_size: frames in the pools (paper: 150 and 1000).
        local_share: the paper's eta, the part of a batch from the local pool.
        new_first: let local frames that no batch has held yet fill up to half of the local part
            (rounded up), the newest first. Ours: by chance alone a frame may wait for seconds.
    """

    def __init__(
        self,
        local_size: int = 150,
        global_size: int = 1000,
        local_share: float | None = None,
        seed: int = 0,
        strategy: PoolStrategy = "paper",
        new_first: bool = False,
    ) -> None:
        local_share = DEFAULT_LOCAL_SHARE[strategy] if local_share is None else local_share
        if local_size < 1 or global_size < 0 or not 0 <= local_share <= 1:
            raise ValueError(
                "local_size must be at least 1, global_size at least 0, local_share in [0, 1]; "
                f"got {local_size}, {global_size}, {local_share}."
            )
        self.local_size = local_size
        self.global_size = global_size
        self.local_share = local_share
        self.strategy: PoolStrategy = strategy
        self.new_first = new_first
        self._local: deque[int] = deque()
        self._global: list[int] = []
        self._undrawn: dict[int, None] = {}  # of the local pool, oldest first
        self._arrived = 0
        self._departed = 0
        self._generator = torch.Generator().manual_seed(seed)

    @property
    def local_frames(self) -> tuple[int, ...]:
        """Frames in the local pool, oldest first."""
        return tuple(self._local)

    @property
    def global_frames(self) -> tuple[int, ...]:
        """Frames in the global pool, in no order that means anything."""
        return tuple(self._global)

    def __len__(self) -> int:
        return len(self._local) + len(self._global)

    def add(self, frame: int) -> int | None:
        """Take in the stream's next frame; return the frame that no pool holds any more, if any."""
        dropped = None
        if len(self._local) == self.local_size:
            oldest = self._local.popleft()
            self._undrawn.pop(oldest, None)
            dropped = self._offer_to_global(oldest)
        self._local.append(frame)
        self._undrawn[frame] = None
        self._arrived += 1
        return dropped

    def _offer_to_global(self, frame: int) -> int | None:
        """Reservoir sampling: the j-th frame to leave the local pool stays with chance size/j."""
        self._departed += 1
        if len(self._global) < self.global_size:
            self._global.append(frame)
            return None
        slot = int(torch.randint(self._departed, (), generator=self._generator))
        if slot >= self.global_size:
            return frame
        self._global[slot], dropped = frame, self._global[slot]
        return dropped

    def batch(self, batch_size: int, evenly: bool = False) -> list[int]:
        """Draw different frames, the local pool's share of them (rounded) from the local pool.

        Where one pool has too few, the other fills up; the batch is smaller than asked for only
        while both together hold fewer frames. Once no more frames come, `evenly` gives all that
        the pools hold the same chance. Raises UserError while there are none.
        """
        if not len(self):
            raise UserError("No frame has arrived yet.", "Add a frame before drawing a batch.")
        if evenly:
            return self._draw([*self._local, *self._global], min(batch_size, len(self)))
        wanted = round(self._present_local_share() * batch_size)
        from_global = min(batch_size - wanted, len(self._global))
        from_local = min(batch_size - from_global, len(self._local))
        from_global = min(batch_size - from_local, len(self._global))
        return self._draw_local(from_local) + self._draw(self._global, from_global)

    def _present_local_share(self) -> float:
        if self.strategy == "paper":
            return self.local_share
        return 1.0 - (1.0 - self.local_share) * min(1.0, self._arrived / _RAMP_FRAMES)

    def _draw_local(self, count: int) -> list[int]:
        new = list(self._undrawn)[::-1][: math.ceil(count / 2)] if self.new_first else []
        taken = set(new)
        others = [frame for frame in self._local if frame not in taken]
        drawn = new + self._draw(others, count - len(new), self.strategy == "release")
        for frame in drawn:
            self._undrawn.pop(frame, None)
        return drawn

    def _draw(self, pool: list[int], count: int, favour_newest: bool = False) -> list[int]:
        if favour_newest and count:
            age = torch.arange(len(pool), dtype=torch.float64)
            weight = torch.exp(age / _NEWEST_FRAMES)
            order = torch.multinomial(weight, count, generator=self._generator)
        else:
            order = torch.randperm(len(pool), generator=self._generator)[:count]
        return [pool[i] for i in order.tolist()]

    def state_dict(self) -> dict[str, Any]:
        """All that the next draws depend on, safe for `torch.load(weights_only=True)`."""
        return {
            "local": list(self._local),
            "global": list(self._global),
            "undrawn": list(self._undrawn),
            "arrived": self._arrived,
            "departed": self._departed,
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken; raises UserError where its pools do not fit in."""
        if len(state["local"]) > self.local_size or len(state["global"]) > self.global_size:
            raise UserError(
                f"The saved pools hold {len(state['local'])} and {len(state['global'])} frames, "
                f"more than {self.local_size} and {self.global_size}.",
                "Resume with pools of at least the size that the run was started with.",
            )
        self._local = deque(state["local"])
        self._global = list(state["global"])
        self._undrawn = dict.fromkeys(state["undrawn"])
        self._arrived = state["arrived"]
        self._departed = state["departed"]
        # A copy: loading moves state to the run's device and may share its memory.
        self._generator.set_state(state["generator"].cpu().clone())
