"""Batches from the pools of a running stream."""

import dataclasses
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras

from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.data import DatasetWriter, LocalGlobalPools, load_dataset
from rgbavatar_ns.data.sampling import PoolStrategy
from rgbavatar_ns.data.streams import (
    FrameStream,
    Ingest,
    ReplayBatch,
    ReplayBuffer,
    ReplayStream,
    Rewindable,
    StreamSubject,
)
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_folder
from rgbavatar_ns.options import Between, Share
from rgbavatar_ns.plugin.cameras import to_nerfstudio
from rgbavatar_ns.plugin.console import say
from rgbavatar_ns.plugin.datamanager import (
    RGBAvatarDataManager,
    RGBAvatarDataManagerConfig,
)
from rgbavatar_ns.plugin.dataparser import FilmedSubject
from rgbavatar_ns.plugin.online.least_losses import LeastLosses
from rgbavatar_ns.plugin.online.sources import SourceConfig, await_subject, open_source

STREAM_FOLDER = "stream"
"""Where a run's folder has what its pools held."""


@dataclass
class OnlineDataManagerConfig(RGBAvatarDataManagerConfig):
    """A stream of frames, and which of them a batch holds (RGBAvatar, sec. 3.3)."""

    _target: type = field(default_factory=lambda: OnlineDataManager)
    source: SourceConfig = field(default_factory=SourceConfig)
    """Where the frames come from."""
    strategy: PoolStrategy = "paper"
    """paper: a fixed share of each batch from the local pool; release: the global pool's share
    grows over the first 600 frames to .7, and local draws favour the newest."""
    local_size: Annotated[int, Between(1, 10**6)] = 150
    """Newest frames, which make up the local pool (paper: 150)."""
    global_size: Annotated[int, Between(0, 10**6)] = 1000
    """Frames of the whole past, each equally likely, in the global pool (paper: 1,000)."""
    local_share: Share | None = None
    """The paper's eta, the part of a batch from the local pool: by default .7, and .3 for the
    release's strategy, which begins with 1."""
    new_first: bool = True
    """Let frames that no batch has held yet fill up to half of the local part, rounded up (2 of 3,
    4 of 7), so that none waits for chance. False draws from the local pool by chance alone, as in
    the paper."""
    queue_frames: Annotated[int, Between(1, 10**5)] = 256
    """Frames that may wait to be decoded; beyond, the oldest is dropped, or the source waits
    where it keeps them (a video file)."""
    watch_every: Annotated[int, Between(0, 10**6)] = 0
    """Every so-manieth frame is looked at again and again while a pool holds it, and the least
    loss that it ever had is kept in least.json, to tell what was forgotten (paper, supplement).
    Takes a tenth of the time; 0 watches none."""
    recorded: tyro.conf.Suppress[Path | None] = None
    """Dataset of the frames that the pools held, which the trainer writes for later commands."""
    resumes: tyro.conf.Suppress[bool] = False
    """Set by the trainer: whether what is recorded is the run's own, to be gone on with."""

    def require_trainable(self) -> None:
        """As offline, where a dataset is replayed; other sources are asked when the run begins."""
        if self.source.kind == "replay":
            super().require_trainable()


class OnlineDataManager(RGBAvatarDataManager):
    """Serves batches from local and global pool while the stream goes on.

    In training its dataset is the replayed one, or one of the stream's first frame; nerfstudio's
    other commands see the replayed dataset, or the recorded one.
    """

    config: OnlineDataManagerConfig

    def __init__(
        self,
        config: OnlineDataManagerConfig,
        device: torch.device | str = "cpu",
        test_mode: Literal["test", "val", "inference", "train"] = "val",
        **more: Any,
    ) -> None:
        self._ingest: Ingest | None = None
        self._begun: tempfile.TemporaryDirectory[str] | None = None
        self.images_drawn = 0
        self.least = LeastLosses()
        self.ended_step: int | None = None
        """Step before which the stream ended; None while it goes on."""
        self.begins_anew = False
        """Whether a resumed run whose stream had ended goes on with another one."""
        replayed = config.source.kind == "replay"
        if test_mode == "val" and not replayed:
            # Then --data is no dataset; the first frame makes one.
            self._open(config)
        served = config if replayed else _of_dataset(config, self._begun)
        super().__init__(served, device, test_mode, **more)
        if test_mode == "val":
            if replayed:
                self._open(config)
            self.config = config
            self._show_first_frame_only()

    @property
    def ingest(self) -> Ingest:
        """The stream's way into the pools; RuntimeError in commands that do not train."""
        if self._ingest is None:
            raise RuntimeError("There is a stream only while training.")
        return self._ingest

    def _open(self, config: OnlineDataManagerConfig) -> None:
        parsed = config.dataparser
        stream = open_source(config.source, config.data or parsed.data, say, parsed.importing)
        try:
            self._prepare(config, stream)
        except BaseException:
            stream.close()
            raise

    def _prepare(self, config: OnlineDataManagerConfig, stream: FrameStream) -> None:
        seed = 0 if config.seed is None else config.seed
        pools = _pools(config, seed)
        subject, self._first, left_out = stream.subject(0.0), None, Counter[str]()
        replayed = isinstance(stream, ReplayStream)
        if not replayed:
            subject, self._first = await_subject(stream, say, left_out=left_out)
        assert subject is not None
        if self._first is not None and not (config.resumes and is_recorded(config, subject)):
            # Elsewhere, for what lies in the run's folder stays until nothing can refuse this run;
            # until the process ends, for the viewer is served from there.
            self._begun = tempfile.TemporaryDirectory(prefix="rgbavatar-")
            _record(Path(self._begun.name) / STREAM_FOLDER, subject, [(0, self._first)])
        self.pools = ReplayBuffer(subject, pools, save_images=not replayed)
        self._ingest = Ingest(stream, subject, self.pools, config.queue_frames, say)
        self._ingest.count_left_out(left_out)
        self._subject, self._stream = subject, stream
        self._resumed = False
        if not isinstance(stream, Rewindable):
            # Nothing may be lost while the avatar is being built.
            self._hand_over_first()
            self._ingest.listen()

    def _hand_over_first(self) -> None:
        if self._first is not None:
            self.ingest.give(self._first)
            self._first = None

    def _show_first_frame_only(self) -> None:
        """The model's one frame is the newest; what has not arrived must not be known."""
        first = self.train_dataset.metadata["subject"]
        assert isinstance(first, FilmedSubject)
        self.train_dataset.metadata["subject"] = dataclasses.replace(
            first,
            theta=first.theta[:1].clone(),
            frame_index=first.frame_index[:1],
            train=(0,),
            world_to_camera=first.world_to_camera[:1].clone(),
        )

    def begin_recording(self) -> None:
        """Record the first frame in the run's folder, once nothing can refuse the run any more.

        What an earlier run has recorded there goes, be it of somebody else: unless it is gone on
        with.
        """
        recorded = self.config.recorded
        assert recorded is not None
        if self._begun is not None:
            with atomic_folder(recorded) as folder:
                first = Path(self._begun.name) / STREAM_FOLDER
                shutil.copytree(first, folder, dirs_exist_ok=True)
        elif not self.config.resumes:
            shutil.rmtree(recorded, ignore_errors=True)

    def start(self) -> None:
        """Begin to fill the pools."""
        if not (self._resumed and self.ingest.goes_on):
            self._hand_over_first()
        self.ingest.start()

    def close(self) -> None:
        """End the stream and its threads."""
        if self._ingest is not None:
            self._ingest.close()

    def record(self) -> None:
        """Write the frames that the pools hold as a dataset, where there is none to replay."""
        if self.config.source.kind != "replay" and self.pools.num_added:
            assert self.config.recorded is not None
            _record(self.config.recorded, self._subject, self.pools.held())

    def filmed(self, subject: FilmedSubject) -> FilmedSubject:
        """The subject with all frames that the pools hold now, which may be none."""
        theta, views, index = self.pools.parameters()
        return dataclasses.replace(
            subject,
            theta=theta,
            frame_index=index,
            train=tuple(range(len(theta))),
            world_to_camera=views,
        )

    def next_train(self, step: int) -> tuple[Cameras, dict[str, Any]]:
        """A batch drawn from the pools now; UserError while they are empty."""
        drawn = self.pools.batch(self.config.batch_size, evenly=self.ended_step is not None)
        self.images_drawn += len(drawn.serial)
        return self._served(drawn, step)

    def every_train(self) -> Iterator[tuple[Cameras, dict[str, Any]]]:
        """All that the pools hold once, in the form of training batches."""
        for number, drawn in enumerate(self.pools.in_order(self.config.batch_size)):
            yield self._served(drawn, number)

    def _served(self, drawn: ReplayBatch, step: int) -> tuple[Cameras, dict[str, Any]]:
        """Frames with the backgrounds of a step."""
        count = len(drawn.serial)
        cameras = to_nerfstudio(
            drawn.cameras,
            theta=drawn.theta,
            position=torch.zeros(count, 1),
            times=torch.zeros(count),
        ).to(self.device)
        background = random_backgrounds(step, count, self.seed).to(self.device)
        cameras.metadata = {**(cameras.metadata or {}), "background": background}
        return cameras, {
            "image": drawn.images_rgba.to(self.device),
            "position": list(drawn.serial),
            "step": step,
        }

    def device_frames(self) -> None:
        """None: frames come and go."""

    def get_train_rays_per_batch(self) -> int:
        """Pixels of a whole batch."""
        tracked = self.dataparser.tracked
        return self.config.batch_size * tracked.width * tracked.height

    def get_extra_state(self) -> dict[str, Any]:
        """Pools, frames, counters and random numbers: all of the stream that a run goes on from."""
        if self._ingest is None:
            return {}
        return {
            "stream": self._ingest.state_dict(),
            "images": self.images_drawn,
            "ended_step": self.ended_step,
            "least": self.least.by_frame,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint; nothing where there is no stream to go on with."""
        if self._ingest is None or "stream" not in state:
            return
        self._ingest.load_state_dict(state["stream"])
        self.images_drawn, self.ended_step = state["images"], state["ended_step"]
        if self.ended_step is not None and not self._ingest.goes_on:
            # What is sent or filmed now is no part of the stream that had ended.
            self.ended_step, self.begins_anew = None, True
        self.least = LeastLosses(state.get("least"))
        self._resumed = True


def _pools(config: OnlineDataManagerConfig, seed: int) -> LocalGlobalPools:
    return LocalGlobalPools(
        config.local_size,
        config.global_size,
        config.local_share,
        seed,
        config.strategy,
        config.new_first,
    )


def _of_dataset(
    config: OnlineDataManagerConfig, begun: "tempfile.TemporaryDirectory[str] | None"
) -> OnlineDataManagerConfig:
    """The config as `RGBAvatarDataManager` takes it: `data` is a dataset in the own format."""
    recorded = config.recorded if begun is None else Path(begun.name) / STREAM_FOLDER
    if recorded is None or not recorded.exists():
        raise UserError(
            f"The run has recorded no frames ({recorded}).",
            "Train it: it records its first frame at once, and what its pools hold when it ends.",
        )
    dataparser = dataclasses.replace(config.dataparser)
    return dataclasses.replace(config, data=recorded, dataparser=dataparser)


def is_recorded(config: OnlineDataManagerConfig, subject: StreamSubject) -> bool:
    """Whether the run goes on from a recording of this subject; another measure of it is told.

    Where the trainer has left a recording a checkpoint is to be loaded, which fits no frames of
    another size or head: UserError, before anything takes the recording's place.
    """
    assert config.recorded is not None
    try:
        before = load_dataset(config.recorded)
    except UserError:
        return False
    same_head = before.layout == subject.layout and before.identity.shape == subject.identity.shape
    if not same_head or (before.width, before.height) != (subject.width, subject.height):
        raise UserError(
            f"The stream has {subject.width} x {subject.height} pixels and the head "
            f"'{subject.arrays.name}', but the run has recorded {before.width} x {before.height} "
            f"pixels and the head '{before.arrays.name}' ({config.recorded}).",
            "Go on with the source that the run was started with, or begin a new run.",
        )
    if not subject.is_shaped_as(before.identity):
        say(
            "note: the person was measured anew, a little otherwise than when the run began; the "
            "avatar keeps the first measure, and may lie a little beside what is filmed now."
        )
    return True


def _record(destination: Path, subject: Any, frames: Any) -> None:
    # As a whole, so that a killed run keeps what it recorded before.
    with atomic_folder(destination) as folder:
        writer = DatasetWriter(
            folder,
            subject.arrays,
            subject.identity,
            subject.layout,
            subject.width,
            subject.height,
        )
        for serial, frame in frames:
            writer.add_encoded(
                serial,
                frame.theta,
                frame.camera,
                frame.encoded(),
                has_unfilmed=frame.marks_unfilmed,
            )
        writer.finish(0)
