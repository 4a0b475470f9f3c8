"""Training while the frames arrive: from the first of them until the stream ends, and a little on.

RGBAvatar, sec. 3.3. The stream runs in its own threads; a step takes what the pools hold.
"""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from nerfstudio.utils import writer
from nerfstudio.utils.misc import step_check

from rgbavatar_ns.avatar.storage.checkpoint_file import CONFIG_NAME
from rgbavatar_ns.avatar.training.batches import TrainingBatch
from rgbavatar_ns.avatar.training.step import Losses
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Between, Count, Counted
from rgbavatar_ns.plugin.console import say
from rgbavatar_ns.plugin.errors import install_user_error_hook
from rgbavatar_ns.plugin.online.datamanager import STREAM_FOLDER, OnlineDataManager
from rgbavatar_ns.plugin.online.pipeline import OnlinePipeline, OnlinePipelineConfig
from rgbavatar_ns.plugin.online.progress import OnlineProgress, StreamReport
from rgbavatar_ns.plugin.option_order import led_by
from rgbavatar_ns.plugin.training.interruption import StopRequest
from rgbavatar_ns.plugin.training.trainer import (
    CHANGED_FIRST,
    RGBAvatarTrainer,
    RGBAvatarTrainerConfig,
)

_LOOK_INTERVAL_S = 1.0
_LOOKED_AT = 2
_LOOK_SHARE = 0.05
"""Of the time, at most, that looking at the newest frames may take."""
_WATCHED_AT_ONCE = 4
_WATCH_SHARE = 0.1
"""The same of watched frames."""


@led_by(*CHANGED_FIRST)
@dataclass
class OnlineTrainerConfig(RGBAvatarTrainerConfig):
    """A run on a stream, which ends some steps after it."""

    _target: type = field(default_factory=lambda: OnlineTrainer)
    pipeline: OnlinePipelineConfig = field(default_factory=OnlinePipelineConfig)
    """Stream and model."""
    max_num_iterations: Count = 1_000_000_000
    """Steps in all, if the run is to end before the stream does (paper: it does not)."""
    steps_after_stream: Counted = 500
    """Steps on all that the pools hold, each frame as likely, once the stream has ended (paper:
    0)."""
    final_learning_rate_factor: Annotated[float, Between(1e-9, 1e3)] = 0.1
    """What the learning rates fall to in these steps, times what they were; 1 keeps them
    (paper)."""

    def lie_in(self, folder: Path) -> None:
        """As offline, with what the stream's pools held."""
        super().lie_in(folder)
        manager = self.pipeline.datamanager
        if manager.recorded is not None:
            manager.recorded = folder / manager.recorded.name


class OnlineStop(StopRequest):
    """Ctrl-C is how a live run ends: it leaves exit code 0."""

    @property
    def exit_code(self) -> int:
        """0 after Ctrl-C, 143 after SIGTERM."""
        return 0 if self.signal_number == signal.SIGINT else super().exit_code


class OnlineTrainer(RGBAvatarTrainer):
    """Trains from the first frame on; the stream's end, Ctrl-C and faults of the source save."""

    config: OnlineTrainerConfig
    pipeline: OnlinePipeline

    def __init__(
        self, config: OnlineTrainerConfig, local_rank: int = 0, world_size: int = 1
    ) -> None:
        install_user_error_hook()
        if config.pipeline.model.refine_tracking:
            raise UserError(
                "Tracking is refined frame by frame, which a stream's passing frames do not wait "
                "for.",
                "Leave out --pipeline.model.refine-tracking, or train offline.",
            )
        falls = config.position_lr_final is not None or config.learning_rate_factor != 1.0
        if falls and config.learning_rate_steps is None:
            raise UserError(
                "Learning rates are to fall, but nobody knows how long the stream is.",
                "Say over how many steps by --learning-rate-steps.",
            )
        # Must be known to later commands.
        config.pipeline.datamanager.recorded = config.get_base_dir() / STREAM_FOLDER
        super().__init__(config, local_rank, world_size)
        self.stop = OnlineStop()
        resumes = config.load_dir is not None or config.load_checkpoint is not None
        config.pipeline.datamanager.resumes = resumes
        self._next_look_s = 0.0
        self._next_watch_s, self._last_watched = 0.0, -1
        self._psnr: float | None = None

    @property
    def stream(self) -> OnlineDataManager:
        """Where the frames come from."""
        return self.pipeline.datamanager

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Wait for the stream's subject, then build everything; Ctrl-C meanwhile ends the run.

        What was recorded in the folder is replaced after that, as its config is.
        """
        try:
            super().setup(test_mode)
            self.stream.begin_recording()
        except KeyboardInterrupt:
            say("Stopped before the first frame; there is nothing to save.")
            raise SystemExit(0) from None

    def train(self) -> None:
        """Train until the stream has ended, or a stop is asked for; then save."""
        try:
            super().train()
        finally:
            self.stream.close()

    @property
    def completed(self) -> bool:
        """Whether the steps after the stream's end are done, or the seconds are used up."""
        return self._out_of_time or self.step + 1 >= self._last_step()

    def _last_step(self) -> int:
        """Steps that the run has in all, as far as is known."""
        most, ended = self.config.max_num_iterations, self.stream.ended_step
        return most if ended is None else min(most, ended + self.config.steps_after_stream)

    @contextmanager
    def _shown_progress(self) -> Iterator[None]:
        """Show how stream and training stand, while they run."""
        self.stream.start()
        with OnlineProgress() as self._stream_progress:
            yield

    def _steps(self) -> Iterator[int]:
        """From the first frame on; the stream may end before any of them."""
        if not self._await_frame():
            return
        step = self._start_step
        while step < self._last_step():
            yield step
            step += 1

    def goes_on(self, step: int) -> bool:
        """As offline; also sees whether the stream has ended."""
        if not super().goes_on(step):
            return False
        self._notice_end(step)
        return True

    def after_step(self, step: int, losses: Losses, seconds: float) -> None:
        """As offline, and let the newest frame drive the viewer's avatar."""
        self._settle()
        theta = self.stream.pools.newest_theta()
        if theta is not None:
            with self.train_lock:
                self.pipeline.model.frame_theta[0] = theta.to(self.pipeline.device)
        super().after_step(step, losses, seconds)

    def _tell_step(self, step: int, losses: Losses) -> None:
        """TensorBoard's curves, and about once a second how things stand."""
        if step_check(step, self.config.logging.steps_per_log, run_at_zero=True):
            loss = self._write_scalars(step, losses)
            for name, value in self._report(loss).scalars().items():
                writer.put_scalar(name=f"Stream/{name}", scalar=value, step=step)
        self._look_at_newest(losses, self._stream_progress)
        self._watch()

    @property
    def _images_per_step(self) -> int:
        return self.config.pipeline.datamanager.batch_size

    def _await_frame(self) -> bool:
        """Wait for the first frame; False if a stop was asked for, or none will come."""
        while not self.stream.pools.wait(0.05):
            if self.stop.requested or self.stream.ingest.finished:
                return False
            self._notice_end(self._start_step)
        return True

    def _notice_end(self, step: int) -> None:
        """See whether the stream has ended; raises what ended it against its will, after saving."""
        ingest = self.stream.ingest
        if ingest.failure is not None:
            self._save_if_unsaved()
            self.stream.record()
            raise ingest.failure
        if ingest.finished and self.stream.ended_step is None:
            self.stream.ended_step = step
            say(
                f"The stream has ended after {self.stream.pools.num_added} frames; "
                f"{self.config.steps_after_stream} more steps follow."
            )

    def _settle(self) -> None:
        """After the stream, take the rates a little down after each step.

        They are part of the optimizers' state, so that a resumed run falls on from there. Where
        the user has named a schedule that decides.
        """
        if self.stream.ended_step is None:
            return
        # The stream's end is seen before a step, so that one comes after it in any case.
        share = 1 / max(1, self.config.steps_after_stream)
        for name, optimizer in self.optimizers.optimizers.items():
            if name in self.optimizers.schedulers:
                continue
            for group in optimizer.param_groups:
                group["lr"] *= self.config.final_learning_rate_factor**share

    def _report(self, loss: float) -> StreamReport:
        return StreamReport(
            step=self.step + 1,
            frames=self.stream.pools.num_added,
            fill=self.stream.pools.fill,
            images=self.stream.images_drawn,
            latency_s=self.stream.pools.median_latency_s(),
            psnr=self._psnr,
            loss=loss,
            counts=dict(self.stream.ingest.counts()),
        )

    def _look_at_newest(self, losses: Losses, progress: OnlineProgress) -> None:
        """About once a second: score the newest frames and tell how things stand."""
        began = time.monotonic()
        if began < self._next_look_s:
            return
        recent = self.stream.pools.recent(_LOOK_INTERVAL_S, _LOOKED_AT)
        self._psnr, picture = None, None
        if recent is not None:
            with self.train_lock:
                self._psnr, picture = self.pipeline.look_at(recent)
        report = self._report(self._finite_loss(losses, self.step))
        rate = progress.images_per_second(report.images)
        progress.show(report, rate)
        self.pipeline.status_panel.show(report.lines(rate), picture)
        took = time.monotonic() - began
        self._next_look_s = began + max(_LOOK_INTERVAL_S, took / _LOOK_SHARE)

    def _watch(self) -> None:
        """See what the losses of some watched frames are now; costs the training no more than time.

        Some at a time, so that the least ones of all frames are known alike well.
        """
        began, every = time.monotonic(), self.stream.config.watch_every
        if every == 0 or began < self._next_watch_s:
            return
        frames = self.stream.pools.watched(every, self._last_watched, _WATCHED_AT_ONCE)
        if frames is not None:
            with self.train_lock:
                self.stream.least.see(frames.index, self.pipeline.losses_of(frames))
            self._last_watched = frames.serial[-1]
        self._next_watch_s = began + (time.monotonic() - began) / _WATCH_SHARE

    def _load_checkpoint(self) -> None:
        """As offline; for a new stream after an ended one the rates are the first ones again."""
        super()._load_checkpoint()
        if not self.stream.begins_anew:
            return
        for name, optimizer in self.optimizers.optimizers.items():
            if name not in self.optimizers.schedulers:
                for group in optimizer.param_groups:
                    group["lr"] = self.optimizers.config[name]["optimizer"].lr

    def _save_end(self) -> None:
        # First of all, since many frames are long in recording, and a full disk may refuse them.
        self._save_if_unsaved()
        self.stream.record()
        self.stream.least.write(self.base_dir)
        super()._save_end()
        # The viewer may stay open for hours, in which nobody takes what is filmed or sent.
        self.stream.close()

    def _frames_at_the_end(self) -> Iterator[TrainingBatch]:
        """What the pools hold, however the run ends: a stream's frames are drawn a few times."""
        return self.pipeline.training_frames()

    def _totals(self) -> dict[str, Any]:
        latency = self.stream.pools.median_latency_s()
        return {
            "images": self.stream.images_drawn,
            "frames": self.stream.pools.num_added,
            **({} if latency is None else {"median_latency_s": latency}),
            "stream": dict(self.stream.ingest.counts()),
        }

    def _limit(self) -> str:
        if self._out_of_time or self._last_step() == self.config.max_num_iterations:
            return super()._limit()
        return f"--steps-after-stream {self.config.steps_after_stream}"

    def _tell_end(self, summary: dict[str, Any]) -> None:
        steps, rate = summary["steps"], summary["images_per_second"]
        if self.completed and self._had_all:
            say(self._untrained(steps))
        else:
            how = "Trained" if self.completed else "Stopped after"
            say(f"{how} {steps} steps on {summary['frames']} frames, {rate:.1f} images/s.")
        if not self.completed:
            say(f"Go on with the same command and --load-dir {self.checkpoint_dir}")
        say(f"Config: {self.base_dir / CONFIG_NAME}")
