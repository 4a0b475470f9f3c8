"""How a run ends: what is saved and told once no step follows, whatever the reason."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from torch import Tensor

from rgbavatar_ns.avatar.storage.checkpoint_file import CONFIG_NAME, SUMMARY_NAME
from rgbavatar_ns.avatar.training.batches import TrainingBatch
from rgbavatar_ns.avatar.training.method_step import MethodStep
from rgbavatar_ns.avatar.training.step import TrainingStep
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_write, write_json
from rgbavatar_ns.plugin.console import say
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from rgbavatar_ns.plugin.refinement import REFINED_NAME
from rgbavatar_ns.plugin.training.interruption import StopRequest
from rgbavatar_ns.plugin.training.load_config import COMPLETED
from rgbavatar_ns.plugin.training.optimizers import DecayConfig
from rgbavatar_ns.plugin.training.peak_memory import peak_memory
from rgbavatar_ns.plugin.training.train_clock import TrainClock


class EndingTrainer(Trainer):
    """The part of a trainer that comes after its last step."""

    pipeline: RGBAvatarPipeline
    stop: StopRequest
    _take: TrainingStep | MethodStep
    clock: TrainClock
    """Of the steps alone, over all sessions of the run."""
    _saved_step: int | None
    """Step whose state lies on the disk as it is."""
    _before_end: dict[str, Tensor]
    """What the end of the run has changed of the avatar, as it was; empty before."""

    @property
    @abstractmethod
    def completed(self) -> bool:
        """Whether the run has all that its config asks for: steps, or seconds."""

    @property
    @abstractmethod
    def _images_per_step(self) -> int: ...

    @property
    @abstractmethod
    def _out_of_time(self) -> bool: ...

    @contextmanager
    def _failure_written(self) -> Iterator[None]:
        """Say in training.json what has ended the run against its will."""
        try:
            yield
        except BaseException as error:
            with suppress(UserError):  # A full disk may be what has ended it.
                first_line = (str(error).splitlines() or [""])[0]
                self._write_summary(f"failed: {type(error).__name__} {first_line}".strip())
            raise

    def _save_end(self) -> None:
        """Save, and say how it went."""
        self.training_state = "completed" if self.completed else "paused"
        # First of all, since looking back at many frames takes a while.
        self._save_if_unsaved()
        before = self.pipeline.model.changed_at_end()
        looked = self._take.look_back(self._frames_at_the_end())
        if (self.completed and self.pipeline.model.finish()) or looked:
            self._before_end, self._saved_step = before, None
            self._save_if_unsaved()
        writer.write_out_storage()
        summary = self._write_summary(COMPLETED if self.completed else "stopped")
        self._save_refined()
        self._tell_end(summary)

    def _save_if_unsaved(self) -> None:
        if self.step >= 0 and self.step != self._saved_step:
            self.save_checkpoint(self.step)

    def _frames_at_the_end(self) -> Iterable[TrainingBatch]:
        """The frames to look back at when the run ends."""
        if self.completed and self.pipeline.model.looks_back:
            return self.pipeline.training_frames()
        return ()

    def _stay(self) -> None:
        """Keep the viewer open if it is to stay."""
        for callback in self.callbacks:
            callback.run_callback_at_location(self.step, TrainingCallbackLocation.AFTER_TRAIN)
        if self.completed and not self.config.viewer.quit_on_train_completion:
            self._train_complete_viewer()

    def _tell_end(self, summary: dict[str, Any]) -> None:
        steps, rate = summary["steps"], summary["images_per_second"]
        if self.completed and self._had_all:
            say(self._untrained(steps))
        elif self.completed:
            seconds = summary["train_seconds"]
            why = f" in the {seconds:.0f} s that it was given" if self._out_of_time else ""
            say(f"Trained {steps} steps{why}, {rate:.1f} images/s.")
            self._tell_bases_that_waited()
        else:
            say(
                f"Stopped after {steps} of {self.config.max_num_iterations} steps; resume with "
                f"the same command and --load-dir {self.checkpoint_dir}"
            )
        say(f"Config: {self.base_dir / CONFIG_NAME}")
        say(f"Checkpoints: {self.checkpoint_dir}")

    @property
    def _had_all(self) -> bool:
        """Whether a run that goes on had all its steps before."""
        return 0 <= self.step < self._start_step

    def _untrained(self, steps: int) -> str:
        return (
            f"Nothing was trained: the run has had {steps} steps before, which count too, and "
            f"{self._limit()} asks for no more. Name a larger one to go on."
        )

    def _limit(self) -> str:
        """The option that has ended the run, as it was given."""
        if self._out_of_time:
            return f"--max-train-seconds {self.config.max_train_seconds:g}"  # type: ignore[attr-defined]
        return f"--max-num-iterations {self.config.max_num_iterations}"

    def _tell_bases_that_waited(self) -> None:
        """Say where refined tracking let the bases wait for longer than the run took."""
        for name, group in self.pipeline.get_param_groups().items():
            schedule = self.optimizers.config[name]["scheduler"]
            start = schedule.start_step if isinstance(schedule, DecayConfig) else 0
            if start > self.step and not any(bool(parameter.any()) for parameter in group):
                say(
                    f"note: the bases have learned nothing, since they begin with step {start}. "
                    "Give the run more time, or name fewer --learning-rate-steps."
                )
                return

    def _save_refined(self) -> None:
        """Write theta of all frames, corrected or calibrated, as float32 [F, H]."""
        model = self.pipeline.model
        if model.refinement is not None:
            theta = model.refinement.all_frames(model.frame_theta).cpu().numpy()
            with atomic_write(self.base_dir / REFINED_NAME) as partial:
                np.save(partial, theta.astype(np.float32))

    def _totals(self) -> dict[str, Any]:
        """What the run has seen over all its sessions: "images", and more by other names."""
        return {"images": (self.step + 1) * self._images_per_step}

    def _write_summary(self, ended: str) -> dict[str, Any]:
        """How the run ended, its length and speed over all its sessions, as training.json."""
        self.clock.settle()
        seconds, totals = self.clock.seconds, self._totals()
        summary = {
            "ended": ended,
            "steps": self.step + 1,
            "train_seconds": seconds,
            "images_per_second": totals["images"] / seconds if seconds > 0 else 0.0,
            **totals,
            **peak_memory(self.pipeline.device),
        }
        write_json(self.base_dir / SUMMARY_NAME, summary)
        return summary

    def _train_complete_viewer(self) -> None:
        """Keep the viewer open until Ctrl-C, which then ends the run with exit code 0."""
        if self.viewer_state is None:
            return
        self.viewer_state.training_complete()
        say(
            "The viewer stays open; Ctrl-C ends it. (--viewer.quit-on-train-completion True ends "
            "with the training, --vis tensorboard has none.)"
        )
        while not self.stop.wait(1.0):
            pass
        self.stop.signal_number = None
