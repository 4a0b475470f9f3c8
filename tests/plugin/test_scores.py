"""Scores over held-out frames, also where one of them does not show the person."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from rgbavatar_ns.avatar.metrics import mean_scores
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.data.native.format import image_path
from rgbavatar_ns.data.png import encode_png_rgba
from tests.plugin.run import make_trainer, small_config


def test_a_score_is_the_mean_over_the_frames_that_have_it():
    frames = [{"psnr": 20.0, "head": math.nan}, {"psnr": 30.0, "head": 7.0}, {"psnr": 40.0}]
    assert mean_scores(frames) == {"psnr": 30.0, "head": 7.0}
    assert math.isnan(mean_scores(frames[:1])["head"])


@pytest.mark.parametrize("get_std", [False, True])
def test_a_held_out_frame_without_the_person_leaves_the_others_scores(
    tiny_data: Path, tmp_path: Path, get_std: bool
):
    data = tmp_path / "data"
    shutil.copytree(tiny_data, data)
    dataset = load_dataset(data)
    blank = np.zeros((dataset.height, dataset.width, 4), np.uint8)
    last = dataset.frame_index[dataset.test[-1]]
    image_path(data, last).write_bytes(encode_png_rgba(blank))
    pipeline = make_trainer(small_config(data, tmp_path)).pipeline.eval()
    found = pipeline.get_average_eval_image_metrics(get_std=get_std)
    heads = [scores["psnr_head"] for scores in pipeline.model.scores]
    assert math.isnan(heads[-1])
    assert found["psnr_head"] == pytest.approx(np.mean(heads[:-1]))
    assert math.isfinite(found["psnr"])
    json.dumps({k: v for k, v in found.items() if isinstance(v, float)}, allow_nan=False)
