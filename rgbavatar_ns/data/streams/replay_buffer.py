"""The pools with their frames: decoded images in memory that does not grow."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.data.sampling import LocalGlobalPools
from rgbavatar_ns.data.streams.protocol import Rereadable, StreamedFrame, StreamSubject
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels.types import PinholeCameras

_RECENT = 500


@dataclass(frozen=True)
class ReplayBatch:
    """B different frames of the pools; `serial` counts the stream's frames from 0."""

    serial: tuple[int, ...]
    theta: Float[Tensor, "B H"]
    cameras: PinholeCameras
    images_rgba: UInt8[Tensor, "B H_px W_px 4"]


@dataclass
class _Kept:
    """What belongs to a frame beside its rows in the tables."""

    index: int
    arrived_s: float
    png: bytes | None
    """As it came, or as it was encoded for a checkpoint."""


class ReplayBuffer:
    """Feeds `LocalGlobalPools` and keeps the frames that they hold, and no others.

    Safe to use from several threads: one adds, another draws; each waits for the other no longer
    than a copy takes. Images are uint8 in one table of all places that the pools have, so that
    memory is bounded and stays in one piece.

    Args:
        subject: whose frames these are.
        pools: the sampling; nobody else must use it.
        save_images: whether `state_dict` holds the images. Those that came as pixels are encoded
            when it is called.
        clock: in seconds, the source's.
    """

    def __init__(
        self,
        subject: StreamSubject,
        pools: LocalGlobalPools,
        save_images: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._subject, self._pools, self._save_images = subject, pools, save_images
        self._clock = clock
        places = pools.local_size + pools.global_size
        height, width = subject.height, subject.width
        # The system gives memory to the places as they are first written to.
        self._images = torch.empty((places, height, width, 4), dtype=torch.uint8)
        self._theta = torch.empty((places, subject.layout.size))
        self._world_to_camera = torch.empty((places, 4, 4))
        self._focal_px = torch.empty((places, 2))
        self._principal_point_px = torch.empty((places, 2))
        self._free = list(range(places))[::-1]
        self._place: dict[int, int] = {}
        self._kept: dict[int, _Kept] = {}
        self._waiting: dict[int, float] = {}  # arrival of frames that no batch has held
        self._latencies_s: deque[float] = deque(maxlen=_RECENT)
        self._added = 0
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)

    @property
    def num_added(self) -> int:
        """Frames taken in so far."""
        return self._added

    @property
    def fill(self) -> tuple[int, int]:
        """Frames in the local and the global pool."""
        with self._lock:
            return len(self._pools.local_frames), len(self._pools.global_frames)

    def add(self, frame: StreamedFrame) -> None:
        """Take in the next frame, decoded; raises UserError where its image is damaged."""
        decoded = frame.decode()
        with self._changed:
            serial = self._added
            dropped = self._pools.add(serial)
            if dropped is not None:
                self._forget(dropped)
            self._hold(serial, decoded, frame)
            self._waiting[serial] = frame.arrived_s
            self._added += 1
            self._changed.notify_all()

    def _hold(self, serial: int, frame: TrackedFrame, streamed: StreamedFrame) -> None:
        place = self._free.pop()
        self._place[serial] = place
        png = streamed.png if self._save_images else None
        self._kept[serial] = _Kept(frame.index, streamed.arrived_s, png)
        self._images[place] = torch.from_numpy(frame.image_rgba)
        self._theta[place] = frame.theta
        camera = frame.camera
        self._world_to_camera[place] = camera.world_to_camera[0]
        self._focal_px[place] = camera.focal_px[0]
        self._principal_point_px[place] = camera.principal_point_px[0]

    def _forget(self, serial: int) -> None:
        self._free.append(self._place.pop(serial))
        del self._kept[serial]
        self._waiting.pop(serial, None)

    def wait(self, timeout_s: float) -> bool:
        """Wait for the first frame; say whether it has come."""
        with self._changed:
            return self._changed.wait_for(lambda: self._added > 0, timeout_s)

    def batch(self, batch_size: int, evenly: bool = False) -> ReplayBatch:
        """Draw a batch as `LocalGlobalPools.batch`; raises UserError while there are no frames."""
        with self._lock:
            serials = self._pools.batch(batch_size, evenly)
            now = self._clock()
            for serial in serials:
                arrived_s = self._waiting.pop(serial, None)
                if arrived_s is not None:
                    self._latencies_s.append(now - arrived_s)
            return self._gather(serials)

    def newest(self) -> ReplayBatch | None:
        """The newest frame as a batch of one, without drawing; None before the first."""
        with self._lock:
            local = self._pools.local_frames
            return self._gather(local[-1:]) if local else None

    def recent(self, seconds: float, most: int) -> ReplayBatch | None:
        """Up to `most` of the local pool's frames that arrived in the last seconds, evenly taken.

        None where there are none.
        """
        with self._lock:
            since = self._clock() - seconds
            local = self._pools.local_frames
            late = [serial for serial in local if self._kept[serial].arrived_s >= since]
            chosen = late[:: -max(1, -(-len(late) // most))]
            return self._gather(chosen) if chosen else None

    def newest_theta(self) -> Float[Tensor, "H"] | None:
        """Theta of the newest frame; None before the first."""
        with self._lock:
            local = self._pools.local_frames
            return self._theta[self._place[local[-1]]].clone() if local else None

    def thetas(self) -> tuple[Float[Tensor, "F H"], tuple[int, ...]]:
        """Theta and serial of all that the pools hold, in the order of their arrival."""
        with self._lock:
            serials = sorted(self._place)
            return self._theta[[self._place[serial] for serial in serials]], tuple(serials)

    def held(self) -> list[tuple[int, StreamedFrame]]:
        """Serial and frame of all that the pools hold, in the order of their arrival."""
        with self._lock:
            return [(serial, self._streamed(serial)) for serial in sorted(self._place)]

    def _streamed(self, serial: int) -> StreamedFrame:
        kept, batch = self._kept[serial], self._gather([serial])
        return StreamedFrame(
            kept.index, batch.theta[0], batch.cameras, kept.arrived_s, png=self._png(serial)
        )

    def _png(self, serial: int) -> bytes:
        kept = self._kept[serial]
        png = kept.png
        if png is None:
            png = encode_png_rgba(self._images[self._place[serial]].numpy())
            if self._save_images:
                kept.png = png  # The next checkpoint holds it too.
        return png

    def _gather(self, serials: Sequence[int]) -> ReplayBatch:
        rows = torch.tensor([self._place[serial] for serial in serials])
        cameras = PinholeCameras(
            self._world_to_camera[rows],
            self._focal_px[rows],
            self._principal_point_px[rows],
            self._subject.width,
            self._subject.height,
        )
        return ReplayBatch(tuple(serials), self._theta[rows], cameras, self._images[rows])

    def median_latency_s(self) -> float | None:
        """From arrival to first use in a batch, of the last 500 frames used first; None before."""
        with self._lock:
            return float(np.median(self._latencies_s)) if self._latencies_s else None

    def state_dict(self) -> dict[str, Any]:
        """Pools and frames, safe for `torch.load(weights_only=True)`."""
        with self._lock:
            serials = sorted(self._place)
            rows = torch.tensor([self._place[serial] for serial in serials], dtype=torch.long)
            kept = [self._kept[serial] for serial in serials]
            state = {
                "pools": self._pools.state_dict(),
                "added": self._added,
                "serial": torch.tensor(serials, dtype=torch.long),
                "index": torch.tensor([one.index for one in kept], dtype=torch.long),
                **{name: table[rows] for name, table in self._tables().items()},
            }
            images = [self._png(serial) for serial in serials] if self._save_images else []
        if self._save_images:
            state["png_bytes"] = torch.tensor([len(png) for png in images], dtype=torch.long)
            state["png"] = torch.from_numpy(np.frombuffer(b"".join(images), np.uint8).copy())
        return state

    def _tables(self) -> dict[str, Tensor]:
        return {
            "theta": self._theta,
            "world_to_camera": self._world_to_camera,
            "focal_px": self._focal_px,
            "principal_point_px": self._principal_point_px,
        }

    def load_state_dict(self, state: dict[str, Any], stream: object = None) -> None:
        """Go on where `state_dict` was taken, before the first `add`.

        Images that the state does not hold are asked for from `stream`. Raises UserError where
        there is no such stream, pools do not fit in, or images are damaged or of another size.
        """
        images = self._saved_images(state, stream)
        size = self._subject.width, self._subject.height
        now = self._clock()
        with self._lock:
            self._pools.load_state_dict(state["pools"])
            for row, (serial, index) in enumerate(
                zip(state["serial"].tolist(), state["index"].tolist())
            ):
                tables = {name: state[name][row : row + 1].cpu() for name in self._tables()}
                theta = tables.pop("theta")[0]
                camera = PinholeCameras(**tables, width=size[0], height=size[1])
                streamed = StreamedFrame(index, theta, camera, now, png=images[row])
                frame = streamed.decode()
                if frame.image_rgba.shape[1::-1] != size:
                    raise UserError(
                        f"The checkpoint's frames have another size than the stream's {size[0]} x "
                        f"{size[1]} pixels.",
                        "Resume with the stream that the run was started with.",
                    )
                self._hold(serial, frame, streamed)
            self._added = state["added"]

    def _saved_images(self, state: dict[str, Any], stream: object) -> list[bytes]:
        if "png" in state:
            whole = state["png"].cpu().numpy().tobytes()
            ends = np.cumsum(state["png_bytes"].tolist()).tolist()
            return [whole[start:end] for start, end in zip([0, *ends], ends)]
        if not isinstance(stream, Rereadable):
            raise UserError(
                "The checkpoint was made while a dataset was replayed and holds no images.",
                "Resume with that dataset: --data FOLDER "
                "--pipeline.datamanager.source.kind replay.",
            )
        return [stream.again(index).encoded() for index in state["index"].tolist()]
