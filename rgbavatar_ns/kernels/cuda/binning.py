"""From projected Gaussians to tiles' sorted lists, in buffers of fixed capacity."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.kernels.cuda.launcher import Launcher
from rgbavatar_ns.kernels.cuda.source import constants
from rgbavatar_ns.kernels.types import PinholeCameras

_SPLAT_FLOATS = 12
_FIRST_GUESS = 4
"""Tiles a Gaussian is thought to touch, before anything was measured."""
_ROOM = 1.5
"""Room for what a later step needs beyond the most that was measured."""


@dataclass(frozen=True)
class Images:
    """How many images of how many Gaussians, and of what size."""

    batch: int
    count: int
    width: int
    height: int

    @property
    def tiles_x(self) -> int:
        """Tiles from left to right."""
        return math.ceil(self.width / constants()["kTileSide"])

    @property
    def tiles_y(self) -> int:
        """Tiles from top to bottom."""
        return math.ceil(self.height / constants()["kTileSide"])

    @property
    def tiles(self) -> int:
        """Tiles of an image."""
        return self.tiles_x * self.tiles_y

    def values(self) -> dict[str, int]:
        """The fields of `Frame` in arguments.h."""
        return {**vars(self), "tiles_x": self.tiles_x, "tiles_y": self.tiles_y}


def camera_values(cameras: PinholeCameras) -> dict[str, Any]:
    """The fields of `CameraArrays` in arguments.h."""
    return {
        "world_to_camera": cameras.world_to_camera.detach().contiguous(),
        "focal_px": cameras.focal_px.detach().contiguous(),
        "principal_point_px": cameras.principal_point_px.detach().contiguous(),
        "count": len(cameras.focal_px),
    }


@dataclass
class Capacities:
    """How many entries an image of some size needed, and reports that are still under way.

    A rendering that trains does not wait for its own report: one that needed more than there was
    room for changes no parameter, and the next ones get more room.
    """

    per_image: dict[tuple[int, int, int], int] = field(default_factory=dict)
    skipped_steps: int = 0
    _reports: list[tuple[tuple[int, int, int], int, Callable[[], list[int] | None]]] = field(
        default_factory=list
    )

    def known(self, images: Images) -> bool:
        """Whether a rendering of this kind has been measured."""
        return self._key(images) in self.per_image

    def of(self, images: Images) -> int:
        """Entries to make room for."""
        each = self.per_image.get(self._key(images), max(_FIRST_GUESS * images.count, images.tiles))
        return min(each * images.batch, constants()["kMostEntries"])

    def learn(self, images: Images, needed: int) -> None:
        """Take the measurement of a whole batch.

        Raises ValueError where no lists can be as long as that.
        """
        self._learn(self._key(images), images.batch, needed)

    def await_report(self, images: Images, read: Callable[[], list[int] | None]) -> None:
        """Take a measurement when it has arrived."""
        self._reports.append((self._key(images), images.batch, read))

    def _learn(self, key: tuple[int, int, int], batch: int, needed: int) -> None:
        if needed >= constants()["kMostEntries"]:
            count, width, height = key
            raise ValueError(
                f"{batch} images of {width} x {height} px, in which {count} Gaussians touch "
                f"{needed} tiles or more: lists cannot be as long as that. "
                "Draw fewer or smaller images at a time, or look for Gaussians grown huge."
            )
        room = math.ceil(needed / batch * _ROOM) + 1
        self.per_image[key] = max(self.per_image.get(key, 0), room)

    def collect(self) -> None:
        """Learn from the reports that have arrived, from each once.

        Raises ValueError as `learn`.
        """
        for _ in range(len(self._reports)):
            key, batch, read = report = self._reports.pop(0)
            status = read()
            if status is None:
                self._reports.append(report)
            # Growth only: a smaller need leaves the room as it is.
            elif status[constants()["kOverflow"]]:
                self.skipped_steps += 1
                self._learn(key, batch, status[constants()["kSlotsNeeded"]])

    @staticmethod
    def _key(images: Images) -> tuple[int, int, int]:
        return images.count, images.width, images.height


class Bins:
    """The tiles' lists of one batch. `project` launches what fills splats and counts."""

    def __init__(
        self,
        launcher: Launcher,
        capacities: Capacities,
        images: Images,
        project: Callable[[Mapping[str, Any]], None],
    ) -> None:
        self.images, self._launcher, self._capacities = images, launcher, capacities
        device, places = launcher.device, images.batch * images.count

        def integers(count: int, dtype: torch.dtype = torch.int32) -> Tensor:
            return torch.empty(count, dtype=dtype, device=device)

        if not launcher.capturing():
            capacities.collect()
        self._capacity = capacities.of(images)
        self._tensors = {
            "splats": torch.empty(places * _SPLAT_FLOATS, device=device),
            "slot_start": integers(places),
            "tile_count": integers(images.batch * images.tiles).zero_(),
            "tile_start": integers(images.batch * images.tiles + 1),
            "entries": integers(self._capacity, torch.int64),
            "status": integers(constants()["kStatusNumbers"]).zero_(),
        }
        self._sorted = self._checked = False
        if images.count:  # a kernel that blends reads a Gaussian for every thread of a warp
            project(self.values())

    def values(self) -> dict[str, Any]:
        """The fields of `Bins` in arguments.h."""
        return {**self._tensors, "capacity": self._capacity}

    @property
    def capacity(self) -> int:
        """Entries, and slots, that there is room for."""
        return self._capacity

    @property
    def status(self) -> Tensor:
        """See arguments.h."""
        return self._tensors["status"]

    def sort(self, *, checked: bool) -> None:
        """Make the lists, once; `checked` waits for their length and gives them the room.

        Unchecked, an overflow is known on the device at once and here later.
        """
        first = not self._capacities.known(self.images)
        checked = (checked or first) and not self._launcher.capturing()
        if self._sorted and (self._checked or not checked):
            return
        if self._sorted:  # the counts were used up: only an overflow asks for them again
            self._checked = True
            if self.status.tolist()[constants()["kOverflow"]] == 0:
                return
            raise RuntimeError(
                "A training step's lists overflowed and cannot be drawn. Render the batch anew."
            )
        frame = self.images.values()
        self._launcher.launch("scan", (1, 1), frame=frame, bins=self.values())
        if checked:
            needed = self.status.tolist()[constants()["kSlotsNeeded"]]
            self._capacities.learn(self.images, needed)
            if needed > self._capacity:
                self._capacity = self._capacities.of(self.images)
                self._tensors["entries"] = torch.empty(
                    self._capacity, dtype=torch.int64, device=self._launcher.device
                )
                self._launcher.launch("scan", (1, 1), frame=frame, bins=self.values())
        elif not self._launcher.capturing():
            self._capacities.await_report(self.images, self._launcher.read_later(self.status))
        grid = (blocks(self.images.count, "kTileThreads"), self.images.batch)
        self._launcher.launch("scatter", grid, frame=frame, bins=self.values())
        self._launcher.launch("sort", self.tile_grid, frame=frame, bins=self.values())
        self._sorted, self._checked = True, checked

    def make_room(self, needed: int) -> None:
        """Give later batches of this kind room for at least so many entries and slots."""
        self._capacities.learn(self.images, needed)

    @property
    def tile_grid(self) -> tuple[int, int]:
        """One block a tile of an image."""
        return self.images.tiles, self.images.batch


def blocks(count: int, threads: str) -> int:
    """Blocks of so many threads (a name in the sources) that hold `count` of them."""
    return max(1, math.ceil(count / constants()[threads]))
