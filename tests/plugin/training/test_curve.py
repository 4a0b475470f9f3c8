"""Held-out scores against seconds of training, and what the run took of memory."""

import json
from collections.abc import Callable

from rgbavatar_ns.plugin.training.curve import read_curve
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer
from tests.plugin.run import newest_state

Train = Callable[..., RGBAvatarTrainer]
EVERY = {"steps_per_eval_all_images": 3}


def test_a_resumed_run_goes_on_with_its_curve(train: Train):
    whole = train("whole", max_num_iterations=11, **EVERY)
    points = read_curve(whole.base_dir / "curve.json")
    assert [point["step"] for point in points] == [3, 6, 9]
    seconds = [point["train_seconds"] for point in points]
    summary = json.loads((whole.base_dir / "training.json").read_text())
    assert 0 < seconds[0] < seconds[1] < seconds[2] < summary["train_seconds"]
    assert {"psnr", "ssim"} <= points[0].keys()
    # Once begun anew from step 4: the points at 6 and 9 are the new run's, and there once.
    first = train("rest", max_num_iterations=5, **EVERY)
    resumed = train("rest", max_num_iterations=11, load_dir=first.checkpoint_dir, **EVERY)
    again = read_curve(resumed.base_dir / "curve.json")
    assert [point["step"] for point in again] == [3, 6, 9]
    assert [point["psnr"] for point in again] == [point["psnr"] for point in points]
    assert again[0] == read_curve(first.base_dir / "curve.json")[0]


def test_evaluations_change_no_training_and_without_them_there_is_no_curve(train: Train):
    watched, plain = train("watched", max_num_iterations=6, **EVERY), train(max_num_iterations=6)
    first, second = (newest_state(run.checkpoint_dir)["pipeline"] for run in (watched, plain))
    assert all(first[name].equal(second[name]) for name in first if hasattr(first[name], "equal"))
    assert read_curve(plain.base_dir / "curve.json") == []


def test_memory_is_that_of_the_process(train: Train):
    summary = json.loads((train(max_num_iterations=1).base_dir / "training.json").read_text())
    assert 100 < summary["peak_mib"] < 100_000
    assert "gpu_peak_mib" not in summary
