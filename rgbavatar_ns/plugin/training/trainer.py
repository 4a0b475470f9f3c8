"""nerfstudio's trainer with checkpoints, resuming and interruption that can be relied on."""

import copy
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
import yaml
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.misc import step_check
from nerfstudio.viewer.viewer import Viewer
from torch import Tensor

from rgbavatar_ns.avatar.storage.checkpoint_file import CONFIG_NAME
from rgbavatar_ns.avatar.storage.stored_avatar import damage_of
from rgbavatar_ns.avatar.training.batches import ChosenFrames, TrainingBatch
from rgbavatar_ns.avatar.training.freed_memory import keep_freed_memory
from rgbavatar_ns.avatar.training.loop import FitHooks, fit
from rgbavatar_ns.avatar.training.step import Losses
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.options import Between, Count, Positive
from rgbavatar_ns.plugin.console import say
from rgbavatar_ns.plugin.errors import device_errors_told, install_user_error_hook
from rgbavatar_ns.plugin.option_order import led_by
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline, RGBAvatarPipelineConfig
from rgbavatar_ns.plugin.training.checkpoints import (
    BEFORE_END,
    checkpoint_of_step,
    link_latest,
    load_newest,
    read_training_state,
    readable_step,
    remove_leftover,
    save_checkpoint,
    state_before_end,
)
from rgbavatar_ns.plugin.training.curve import EvaluationCurve
from rgbavatar_ns.plugin.training.interruption import StopRequest, stop_with_starter
from rgbavatar_ns.plugin.training.load_config import (
    go_on_or_repeat,
    loaded_by_command,
    loads_config,
    require_loadable,
    run_beside,
)
from rgbavatar_ns.plugin.training.optimizers import (
    DecayShape,
    go_on_as_asked,
    require_fitting_states,
    scheduled_optimizers,
)
from rgbavatar_ns.plugin.training.progress import TrainingProgress
from rgbavatar_ns.plugin.training.ranges import require_found, require_trainable
from rgbavatar_ns.plugin.training.run_end import EndingTrainer
from rgbavatar_ns.plugin.training.scalars import finite_loss, write_rates, write_step
from rgbavatar_ns.plugin.training.train_clock import TrainClock, waiting_for
from rgbavatar_ns.plugin.training.turns import TurnsLock
from rgbavatar_ns.plugin.viewer.settings import is_of_ns_viewer, viewer_settings

CHANGED_FIRST = (
    "data", "experiment_name", "output_dir", "max_num_iterations", "max_train_seconds", "vis",
    "load_dir", "load_config", "steps_per_save", "keep_checkpoints",
    "pipeline", "viewer", "machine", "logging", "optimizers",
)  # fmt: skip
"""A run's options in the order in which people change them, for help."""


@led_by(*CHANGED_FIRST)
@dataclass
class RGBAvatarTrainerConfig(TrainerConfig):
    """A run of this method; learning rates are in `optimizers`, one group a kind of parameter."""

    _target: type = field(default_factory=lambda: RGBAvatarTrainer)
    pipeline: RGBAvatarPipelineConfig = field(default_factory=RGBAvatarPipelineConfig)
    """Data and model."""
    max_num_iterations: Count = 5000
    """Steps in all, those before a resume included (paper: 5,000; release: 50,000 images)."""
    max_train_seconds: Positive | None = None
    """End the run, complete, with the step that makes up so many seconds of training, those before
    a resume included, even if steps are left: to compare methods at equal time. Counted as
    training.json's train_seconds: the steps and their waiting for images, neither evaluation nor
    saving. How many steps that makes depends on the machine; rates fall over learning_rate_steps
    all the same, and with refined tracking bases wait for a share of these."""
    position_lr_final: Positive | None = None
    """Let the learning rate of positions fall to this (paper: not; release: 8e-6)."""
    learning_rate_factor: Annotated[float, Between(1e-9, 1e3)] = 1.0
    """Let all other learning rates fall to this multiple of the first one (paper, release: 1)."""
    learning_rate_decay: DecayShape = "exponential"
    """How they fall: each step by the same share (release), or by the same amount."""
    learning_rate_steps: Count | None = None
    """Steps over which learning rates fall (release: 3,000); by default max_num_iterations. Name it
    where a run is to be continued beyond its first end."""
    keep_checkpoints: Count = 2
    """Newest checkpoints kept where save_only_latest_checkpoint is on: a second one, in case the
    newest is damaged."""
    mixed_precision: bool = False
    """Half precision is refused: the rasterizer computes in float32."""
    method_name: tyro.conf.Suppress[str | None] = None
    run_folder: tyro.conf.Suppress[Path | None] = None
    """Where the run lies, once a command has loaded it from there; by default where it began."""

    def get_base_dir(self) -> Path:
        """The run's folder."""
        return self.run_folder or super().get_base_dir()

    def lie_in(self, folder: Path) -> None:
        """Take what the run has written from here, wherever it was trained."""
        self.run_folder = folder

    def get_checkpoint_dir(self) -> Path:
        """Where the run's checkpoints are; for who loads one from there, `load_step` is set.

        ns-eval, ns-viewer and ns-render ask for the folder and then load what is there of
        `load_step`, or the newest, readable or not; so `load_step` becomes the newest that can be
        read. What lies beside the config.yml that they have loaded counts, not where it says.
        Raises UserError where there is none, or not that of a `load_step` already set.
        """
        folder = super().get_checkpoint_dir()
        if not _IN_TRAINER.get():
            install_user_error_hook()
            loaded = loaded_by_command()
            if loaded is not None:
                beside = run_beside(loaded, self.get_base_dir(), say)
                if beside.resolve() != self.get_base_dir().resolve():
                    self.lie_in(beside)
                    folder = super().get_checkpoint_dir()
            self.load_step = readable_step(folder, self.load_step, say)
        return folder

    def save_config(self) -> None:
        """Write config.yml, the first file of a run; raises UserError where none can begin.

        That of a run that lies there already is left to the trainer, which writes it anew once
        nothing can refuse the command any more.
        """
        install_user_error_hook()
        require_trainable(self)
        require_found(self)
        if not (self.get_base_dir() / CONFIG_NAME).exists():
            self.write_config()

    def write_config(self) -> None:
        """Write config.yml, whatever lies there; raises UserError where the disk refuses it.

        The step that a run goes on from is left out: those who read the config want the newest.
        """
        written, path = copy.copy(self), self.get_base_dir() / CONFIG_NAME
        written.load_step = None
        remedy = "Free some space, or name another --output-dir."
        with atomic_write(path, remedy=remedy) as partial:
            partial.write_text(yaml.dump(written), "utf8")

    def set_timestamp(self) -> None:
        """Called by `ns-train` alone, on its own config or on the one that it has loaded."""
        super().set_timestamp()
        if loads_config(sys.argv[1:]):
            go_on_or_repeat(self, sys.argv[1:], say)

    def __setattr__(self, name: str, value: Any) -> None:
        """Where `ns-viewer` puts its own settings in place of the run's, keep these.

        And look at the file of `--load-config` before nerfstudio loads it.
        """
        if name == "viewer" and is_of_ns_viewer(value):
            value = viewer_settings(self.viewer, value, sys.argv[1:])
        super().__setattr__(name, value)
        if name == "load_config" and self.load_config is not None:
            install_user_error_hook()
            require_loadable(self.load_config, sys.argv[1:])


_IN_TRAINER = ContextVar("a trainer asks where to save", default=False)


class RGBAvatarTrainer(EndingTrainer, FitHooks):
    """Trains with nerfstudio's parts around `fit`, whose hooks it is.

    What differs: `max_num_iterations` counts all steps also after a resume; checkpoints are
    atomic and the newest readable one is loaded; SIGINT and SIGTERM save after the present step
    and exit with 130 and 143; scalars are written every `steps_per_log` steps only; the run's
    speed, and how it ended, whatever ended it, is written to training.json.
    """

    config: RGBAvatarTrainerConfig
    pipeline: RGBAvatarPipeline

    def __init__(
        self, config: RGBAvatarTrainerConfig, local_rank: int = 0, world_size: int = 1
    ) -> None:
        install_user_error_hook()
        stop_with_starter()
        require_trainable(config)
        if world_size != 1:
            raise UserError("This method trains on one device.", "Leave out --machine.num-devices.")
        self._asked = copy.deepcopy(config)
        _use_run_seed(config)
        asks = _IN_TRAINER.set(True)
        try:
            super().__init__(config, local_rank, world_size)
        finally:
            _IN_TRAINER.reset(asks)
        self.train_lock: Any = TurnsLock()
        self.stop = StopRequest()
        self.stop_training = False
        self.clock = TrainClock(waiting_for(self.device))
        self._saved_step: int | None = None
        self._before_end: dict[str, Tensor] = {}
        self._is_latest = False

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """Build pipeline, optimisers, viewer and writers; load a checkpoint if one is named.

        Until that is done nothing of a run that lies in the folder is changed.
        """
        self.curve = EvaluationCurve(self.base_dir)
        super().setup(test_mode)
        self._asked.write_config()
        self.pipeline.evaluated = self._add_to_curve
        if isinstance(self.viewer_state, Viewer):
            for line in self.viewer_state.viewer_info:
                say(line)

    def setup_optimizers(self) -> Optimizers:
        """One optimiser a parameter group, with the schedules that the config asks for."""
        return scheduled_optimizers(
            self.config, self.pipeline.get_param_groups(), self.pipeline.model.avatar
        )

    def train(self) -> None:
        """Train until steps or seconds are used up or a stop is asked for; then save."""
        outputs = self.pipeline.datamanager.train_dataparser_outputs
        outputs.save_dataparser_transform(self.base_dir / "dataparser_transforms.json")
        self._init_viewer_state()
        self.step = self._start_step - 1
        with self.stop:
            with self._failure_written():
                with device_errors_told(self.checkpoint_dir):
                    self._take = self.pipeline.training_step(self.optimizers)
                say(f"Steps are {self._take.kind}: {self._take.reason}.")
                if self._take.kind == "eager" and self.device == "cpu":
                    keep_freed_memory()
                with self._shown_progress():
                    fit(self._take, self._batch, self._steps(), self)
                self._save_end()
            self._stay()
        if self.stop.exit_code:
            raise SystemExit(self.stop.exit_code)

    def shutdown(self) -> None:
        """Stop after the present step and close the viewer."""
        self.stop.request()
        super().shutdown()

    @contextmanager
    def _shown_progress(self) -> Iterator[None]:
        """Show how far training is, while it runs."""
        total, seconds = self.config.max_num_iterations, self.config.max_train_seconds
        with TrainingProgress(
            self._start_step, total, self._images_per_step, seconds
        ) as self._progress:
            yield

    @property
    def _images_per_step(self) -> int:
        tracked = self.pipeline.datamanager.dataparser.tracked
        pixels = self.pipeline.datamanager.get_train_rays_per_batch()
        return pixels // (tracked.width * tracked.height)

    def _steps(self) -> Iterable[int]:
        return range(self._start_step, self.config.max_num_iterations)

    def _batch(self, step: int) -> TrainingBatch | ChosenFrames:
        return self.pipeline.training_batch(step, self._take.kind)

    def goes_on(self, step: int) -> bool:
        """Wait while the viewer's pause button is on; False if training is to stop."""
        while self.training_state == "paused" and not self.stop.requested:
            self.stop.wait(0.01)
        return not (self.stop.requested or self.stop_training or self._out_of_time)

    @contextmanager
    def around_step(self, step: int) -> Iterator[None]:
        """Under the viewer's lock: nerfstudio's callbacks, the step, the schedules."""
        with device_errors_told(self.checkpoint_dir), self.train_lock:
            self.pipeline.train()
            self._run_callbacks(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
            yield
            for scheduler in self.optimizers.schedulers.values():
                scheduler.step()
            self._run_callbacks(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)

    def after_step(self, step: int, losses: Losses, seconds: float) -> None:
        """Tell, evaluate and save what is due."""
        self.step = step
        self.clock.add(seconds)
        self._update_viewer_state(step)
        self._tell_step(step, losses)
        if len(self.pipeline.datamanager.eval_dataset) > 0:
            with self.train_lock:
                if self._evaluates(step):
                    self.clock.settle()
                self.eval_iteration(step)
        if step_check(step, self.config.steps_per_save):
            self.save_checkpoint(step)
        writer.write_out_storage()

    def _evaluates(self, step: int) -> bool:
        own = self.config
        every = (own.steps_per_eval_batch, own.steps_per_eval_image, own.steps_per_eval_all_images)
        return any(step_check(step, steps) for steps in every)

    def _tell_step(self, step: int, losses: Losses) -> None:
        """Curves and progress, every `steps_per_log` steps and at the end."""
        if self.completed or step_check(step, self.config.logging.steps_per_log, run_at_zero=True):
            loss = self._write_scalars(step, losses)
            self._progress.show(step + 1, loss, self.clock.seconds)

    def _add_to_curve(self, step: int, scores: Mapping[str, Any]) -> None:
        """A point of curve.json; `--steps-per-eval-all-images` says how often."""
        self.curve.add(step, self.clock.seconds, scores)

    def _run_callbacks(self, step: int, location: TrainingCallbackLocation) -> None:
        for callback in self.callbacks:
            callback.run_callback_at_location(step, location)

    def _finite_loss(self, losses: Losses, step: int) -> float:
        return finite_loss(losses, step, self.config.optimizers, self.checkpoint_dir)

    def _write_scalars(self, step: int, losses: Losses) -> float:
        """TensorBoard's curves, and the speeds the viewer shares the device by; the loss."""
        self.clock.settle()
        loss = self._finite_loss(losses, step)
        write_step(
            step,
            loss,
            losses,
            images=self._images_per_step,
            pixels=self.pipeline.datamanager.get_train_rays_per_batch(),
            seconds=self.clock.seconds_per_step,
        )
        write_rates(step, self.optimizers.schedulers)
        return loss

    @property
    def completed(self) -> bool:
        """Whether all steps are done, or the seconds for them are used up."""
        return self._out_of_time or self.step >= self.config.max_num_iterations - 1

    @property
    def _out_of_time(self) -> bool:
        most = self.config.max_train_seconds
        return most is not None and self.clock.reaches(most)

    def _load_checkpoint(self) -> None:
        """Load what --load-dir (newest readable) or --load-checkpoint names, if anything."""
        config = self.config
        if config.load_dir is not None:
            state, path = self._choose(config.load_dir)
        elif config.load_checkpoint is not None:
            state, path = read_training_state(config.load_checkpoint), config.load_checkpoint
        else:
            say("Training from the start.")
            return
        remove_leftover(path.parent)
        with damage_of(path):
            self._start_step = state["step"] + 1
            if path.parent.resolve() == self.checkpoint_dir.resolve():
                self._saved_step = state["step"]
            self.clock.resume(float(state.get("train_seconds", 0.0)))
            self.curve.points = [dict(point) for point in state.get("curve", ())]
        self.pipeline.load_pipeline(state_before_end(state), state["step"])
        with damage_of(path):
            self.optimizers.load_optimizers(state["optimizers"])
            require_fitting_states(self.optimizers.optimizers.values())
            if config.load_scheduler:
                known = self.optimizers.schedulers
                resumed = {n: saved for n, saved in state["schedulers"].items() if n in known}
                self.optimizers.load_schedulers(resumed)
                go_on_as_asked(self.optimizers, resumed, self._start_step)
        say(f"Resuming after step {state['step']} from {path}")

    def _choose(self, folder: Path) -> tuple[dict[str, Any], Path]:
        if self.config.load_step is not None:
            path = checkpoint_of_step(folder, self.config.load_step)
            return read_training_state(path), path
        return load_newest(folder, say)

    def save_checkpoint(self, step: int) -> None:
        """Write a checkpoint atomically; raises UserError if it does not fit on the disk."""
        self.clock.settle()
        keep = self.config.keep_checkpoints
        if not self.config.save_only_latest_checkpoint:
            keep = self.config.max_num_iterations
        save_checkpoint(self._state(step), self.checkpoint_dir, step, keep)
        self._saved_step = step
        # Not before: a run that could not begin is of no use to who asks for the latest. Nor again:
        # of two that train at once the one begun last stays it.
        if not self._is_latest:
            link_latest(self.base_dir)
            self._is_latest = True

    def _state(self, step: int) -> dict[str, Any]:
        """What a checkpoint holds."""
        return {
            "step": step,
            "train_seconds": self.clock.seconds,
            "curve": self.curve.points,
            "pipeline": self.pipeline.state_dict(),
            BEFORE_END: self._before_end,
            "optimizers": {k: v.state_dict() for k, v in self.optimizers.optimizers.items()},
            "schedulers": {k: v.state_dict() for k, v in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
        }


def _use_run_seed(config: RGBAvatarTrainerConfig) -> None:
    """Let data and model follow --machine.seed unless they have a seed of their own."""
    for part in (config.pipeline.datamanager, config.pipeline.model):
        if part.seed is None:
            part.seed = config.machine.seed
