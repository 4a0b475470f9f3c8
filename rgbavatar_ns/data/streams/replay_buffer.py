"""The pools with their frames: decoded images in memory that does not grow."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.png import encode_png_rgba
from rgbavatar_ns.data.sampling import LocalGlobalPools
from rgbavatar_ns.data.streams.protocol import StreamedFrame, StreamSubject
from rgbavatar_ns.data.streams.replay import ReplayStream
from rgbavatar_ns.drawing.compositing import unfilmed_pixels
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels.types import CAMERA_TENSORS, PinholeCameras

_RECENT = 500


@dataclass(frozen=True)
class ReplayBatch:
    """B different frames of the pools; `serial` counts the stream's frames from 0.

    `index` is the frames' own numbers.
    """

    serial: tuple[int, ...]
    index: tuple[int, ...]
    theta: Float[Tensor, "B H"]
    cameras: PinholeCameras
    images_rgba: UInt8[Tensor, "B H_px W_px 4"]


@dataclass
class _Held:
    """A frame of the pools; its image as a PNG as it came, or as a checkpoint has encoded it."""

    frame: TrackedFrame
    arrived_s: float
    png: bytes | None

    def as_png(self) -> bytes:
        if self.png is None:
            self.png = encode_png_rgba(self.frame.image_rgba)
        return self.png

    def streamed(self) -> StreamedFrame:
        """As a stream would give it; it marks what nobody filmed where there is any such."""
        frame, marks = self.frame, bool(unfilmed_pixels(self.frame.image_rgba).any())
        return StreamedFrame(
            frame.index,
            frame.theta,
            frame.camera,
            self.arrived_s,
            png=self.as_png(),
            marks_unfilmed=marks,
        )


class ReplayBuffer:
    """Feeds `LocalGlobalPools` and keeps the frames that they hold, and no others.

    Safe to use from several threads: one adds, another draws. `pools` are this buffer's alone;
    `clock` is the source's, in seconds. With `save_images` `state_dict` holds the images.
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
        self._held: dict[int, _Held] = {}
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
        held = self._decoded(frame)
        with self._changed:
            serial = self._added
            dropped = self._pools.add(serial)
            if dropped is not None:
                del self._held[dropped]
                self._waiting.pop(dropped, None)
            self._held[serial] = held
            self._waiting[serial] = frame.arrived_s
            self._added += 1
            self._changed.notify_all()

    def _decoded(self, frame: StreamedFrame) -> _Held:
        decoded = frame.decode()
        # Who brings pixels may use their memory again.
        image = decoded.image_rgba if frame.image_rgba is None else frame.image_rgba.copy()
        own = TrackedFrame(frame.index, frame.theta.clone(), frame.camera, image)
        # What goes on without the frame's word on them must have no marks but real ones.
        keeps_png = self._save_images and frame.marks_unfilmed
        return _Held(own, frame.arrived_s, frame.png if keeps_png else None)

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

    def in_order(self, batch_size: int) -> Iterator[ReplayBatch]:
        """All that the pools hold now, in the order of arrival, in batches."""
        with self._lock:
            serials = sorted(self._held)
        for first in range(0, len(serials), batch_size):
            with self._lock:
                kept = [s for s in serials[first : first + batch_size] if s in self._held]
                batch = self._gather(kept) if kept else None
            if batch is not None:
                yield batch

    def recent(self, seconds: float, most: int) -> ReplayBatch | None:
        """Up to `most` of the local pool's frames of the last seconds, newest first; None: none."""
        with self._lock:
            since = self._clock() - seconds
            local = self._pools.local_frames
            late = [serial for serial in local if self._held[serial].arrived_s >= since]
            chosen = late[:: -max(1, -(-len(late) // most))]
            return self._gather(chosen) if chosen else None

    def watched(self, every: int, after: int, most: int) -> ReplayBatch | None:
        """Up to `most` of each `every`-th frame that a pool holds, in turn; None: there are none.

        after: the last one that was looked at before.
        """
        with self._lock:
            held = sorted(serial for serial in self._held if serial % every == 0)
            turn = sum(serial <= after for serial in held)
            chosen = (held[turn:] + held[:turn])[:most]
            return self._gather(chosen) if chosen else None

    def newest_theta(self) -> Float[Tensor, "H"] | None:
        """Theta of the newest frame; None before the first."""
        with self._lock:
            local = self._pools.local_frames
            return self._held[local[-1]].frame.theta.clone() if local else None

    def parameters(
        self,
    ) -> tuple[Float[Tensor, "F H"], Float[Tensor, "F 4 4"], tuple[int, ...]]:
        """Theta, world_to_camera and serial of all that the pools hold, in order of arrival."""
        with self._lock:
            serials = sorted(self._held)
            columns = self._columns(serials)
            theta = columns["theta"].reshape(-1, self._subject.layout.size)
            return theta, columns["world_to_camera"].reshape(-1, 4, 4), tuple(serials)

    def held(self) -> list[tuple[int, StreamedFrame]]:
        """Serial and frame of all that the pools hold, in the order of their arrival.

        `marks_unfilmed` of a frame is whether there are marks in it.
        """
        with self._lock:
            held = sorted(self._held.items())
        return [(serial, one.streamed()) for serial, one in held]

    def median_latency_s(self) -> float | None:
        """From arrival to first use in a batch, of the last 500 frames used first; None before."""
        with self._lock:
            return float(np.median(self._latencies_s)) if self._latencies_s else None

    def _columns(self, serials: Sequence[int]) -> dict[str, Tensor]:
        """Theta and the cameras' parts of frames, one row a frame."""
        frames = [self._held[serial].frame for serial in serials]
        parts = {"theta": [frame.theta[None] for frame in frames]}
        for name in CAMERA_TENSORS:
            parts[name] = [getattr(frame.camera, name) for frame in frames]
        return {name: torch.cat(rows or [torch.empty(0)]) for name, rows in parts.items()}

    def _gather(self, serials: Sequence[int]) -> ReplayBatch:
        columns = self._columns(serials)
        theta = columns.pop("theta")
        cameras = PinholeCameras(**columns, width=self._subject.width, height=self._subject.height)
        frames = [self._held[serial].frame for serial in serials]
        images = torch.from_numpy(np.stack([frame.image_rgba for frame in frames]))
        index = tuple(frame.index for frame in frames)
        return ReplayBatch(tuple(serials), index, theta, cameras, images)

    def state_dict(self) -> dict[str, Any]:
        """Pools and frames, safe for `torch.load(weights_only=True)`."""
        return self.snapshot()()

    def snapshot(self) -> Callable[[], dict[str, Any]]:
        """What gives the present `state_dict` whenever it is called.

        That takes a while where images came as pixels, and so need not be done where others wait.
        """
        with self._lock:
            serials = sorted(self._held)
            held = [self._held[serial] for serial in serials]
            state = {
                "pools": self._pools.state_dict(),
                "added": self._added,
                "serial": torch.tensor(serials, dtype=torch.long),
                "index": torch.tensor([one.frame.index for one in held], dtype=torch.long),
                **self._columns(serials),
            }
        return lambda: state | (_saved_as_png(held) if self._save_images else {})

    def load_state_dict(self, state: dict[str, Any], stream: object = None) -> None:
        """Go on where `state_dict` was taken, before the first `add`; images may be `stream`'s.

        Raises UserError where pools do not fit in, or images are not to be had or damaged.
        """
        images = _saved_images(state, stream)
        size = self._subject.width, self._subject.height
        now = self._clock()
        with self._lock:
            self._pools.load_state_dict(state["pools"])
            for row, (serial, index) in enumerate(
                zip(state["serial"].tolist(), state["index"].tolist())
            ):
                parts = {name: state[name][row : row + 1].cpu() for name in CAMERA_TENSORS}
                camera = PinholeCameras(**parts, width=size[0], height=size[1])
                theta = state["theta"][row].cpu()
                png, marks = images[row]
                streamed = StreamedFrame(index, theta, camera, now, png=png, marks_unfilmed=marks)
                if streamed.image_size not in (size, None):
                    raise UserError(
                        f"The checkpoint's frames have another size than the stream's {size[0]} x "
                        f"{size[1]} pixels.",
                        "Resume with the stream that the run was started with.",
                    )
                self._held[serial] = self._decoded(streamed)
            self._added = state["added"]


def _saved_as_png(held: Sequence[_Held]) -> dict[str, Tensor]:
    images = [one.as_png() for one in held]
    return {
        "png_bytes": torch.tensor([len(png) for png in images], dtype=torch.long),
        "png": torch.from_numpy(np.frombuffer(b"".join(images), np.uint8).copy()),
    }


def _saved_images(state: dict[str, Any], stream: object) -> list[tuple[bytes, bool]]:
    """Each frame's PNG, and whether marks in it count."""
    if "png" in state:
        whole = state["png"].cpu().numpy().tobytes()
        ends = np.cumsum(state["png_bytes"].tolist()).tolist()
        return [(whole[start:end], True) for start, end in zip([0, *ends], ends)]
    if not isinstance(stream, ReplayStream):
        raise UserError(
            "The checkpoint was made while a dataset was replayed and holds no images.",
            "Resume with that dataset: --data FOLDER --pipeline.datamanager.source.kind replay.",
        )
    frames = [stream.again(index) for index in state["index"].tolist()]
    return [(frame.encoded(), frame.marks_unfilmed) for frame in frames]
