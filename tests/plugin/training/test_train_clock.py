"""Seconds of training where steps return before the device has done them."""

import json
from collections.abc import Callable

import pytest

from rgbavatar_ns.plugin.training.train_clock import TrainClock, waiting_for
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer, RGBAvatarTrainerConfig
from tests.plugin.run import before_each_step, make_trainer


class Device:
    """Takes work at once, and does it while it is waited for, on a clock of its own."""

    def __init__(self) -> None:
        self.time_s = self.left_s = 0.0
        self.waits = 0

    def wait(self) -> None:
        self.waits += 1
        self.time_s += self.left_s
        self.left_s = 0.0

    def clock(self) -> TrainClock:
        return TrainClock(self.wait, lambda: self.time_s)


def test_what_the_device_has_left_to_do_counts() -> None:
    device = Device()
    clock = device.clock()
    for _ in range(5):
        device.left_s += 2.0
        clock.add(0.001)
    assert clock.seconds == pytest.approx(0.005)
    clock.settle()
    assert clock.seconds == pytest.approx(10.005)
    assert clock.seconds_per_step == pytest.approx(2.001)
    clock.settle()
    assert clock.seconds == pytest.approx(10.005)
    assert clock.seconds_per_step == pytest.approx(2.001)


def trainer_on_a_device(config: RGBAvatarTrainerConfig) -> tuple[RGBAvatarTrainer, Device]:
    """A trainer whose steps leave the device three seconds of work."""
    trainer = make_trainer(config)
    device = Device()
    trainer.clock = device.clock()

    def work(step: int) -> None:
        device.left_s += 3.0

    before_each_step(trainer, work)
    return trainer, device


def test_it_goes_on_from_the_sessions_before() -> None:
    device = Device()
    clock = device.clock()
    clock.resume(100.0)
    clock.add(1.0)
    clock.settle()
    assert clock.seconds == 101.0
    assert clock.seconds_per_step == 1.0


def test_seconds_are_reached_with_the_step_that_uses_them_up_and_few_waits() -> None:
    device, steps = Device(), 0
    clock = device.clock()
    while not clock.reaches(1000.0):
        device.left_s += 2.0
        clock.add(0.001)
        steps += 1
    assert steps == 500
    assert device.waits < 20


def test_a_run_of_so_many_seconds_takes_no_step_beyond_them(
    config_of: Callable[..., RGBAvatarTrainerConfig],
) -> None:
    config = config_of(max_num_iterations=30, max_train_seconds=20.0)
    config.logging.steps_per_log = 50
    trainer, _ = trainer_on_a_device(config)
    after_step = trainer.after_step
    trainer.after_step = lambda step, losses, seconds: after_step(step, losses, 0.0)
    trainer.train()
    summary = json.loads((trainer.base_dir / "training.json").read_text())
    assert (summary["steps"], summary["train_seconds"]) == (7, 21.0)


def test_a_cpu_has_done_what_it_was_told() -> None:
    clock = TrainClock(waiting_for("cpu"), lambda: pytest.fail("It looked at the time."))
    clock.add(2.0)
    clock.settle()
    assert clock.seconds == 2.0


def test_a_runs_seconds_are_the_devices_and_evaluation_is_none_of_them(
    config_of: Callable[..., RGBAvatarTrainerConfig],
) -> None:
    config = config_of(max_num_iterations=6, steps_per_eval_all_images=2)
    config.logging.steps_per_log = 4
    trainer, device = trainer_on_a_device(config)
    evaluate = trainer.pipeline.get_average_eval_image_metrics

    def evaluated(*given, **named):
        assert device.left_s == 0.0, (
            "The evaluation waits for steps that the clock has not counted."
        )
        device.time_s += 50.0
        return evaluate(*given, **named)

    trainer.pipeline.get_average_eval_image_metrics = evaluated
    after_step = trainer.after_step
    trainer.after_step = lambda step, losses, seconds: after_step(step, losses, 0.0)
    trainer.train()
    summary = json.loads((trainer.base_dir / "training.json").read_text())
    assert summary["train_seconds"] == pytest.approx(6 * 3.0)
    assert [point["train_seconds"] for point in trainer.curve.points] == [9.0, 15.0]
