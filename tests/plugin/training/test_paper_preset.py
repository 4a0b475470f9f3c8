"""A run of `rgbavatar-paper`: what it does that ours does not, and what it leaves out."""

import copy
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels.constants import MIN_ALPHA
from rgbavatar_ns.plugin.methods import rgbavatar_paper
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig
from tests.plugin.run import SMALL, make_trainer, newest_state, set_up, trained


def paper_config(data: Path, output: Path, **fields: object) -> RGBAvatarTrainerConfig:
    """The preset with few Gaussians."""
    config = copy.deepcopy(rgbavatar_paper.config)
    assert isinstance(config, RGBAvatarTrainerConfig)
    own = config.pipeline.model.avatar
    small = replace(
        SMALL, tangent_variant=own.tangent_variant, theta_within_film=own.theta_within_film
    )
    config.pipeline.datamanager.data = data
    fields = {"batch_size": 4, "avatar": small, "lpips_metric": False} | fields
    set_up(config, output, **fields)
    return config


def test_what_was_never_seen_is_hidden_at_the_end_and_nothing_else(tiny_data: Path, tmp_path: Path):
    """Also where the last step had been saved already, as every fourth is here."""
    steps = {"max_num_iterations": 9, "steps_per_save": 4}
    trainer = trained(paper_config(tiny_data, tmp_path / "hidden", **steps))
    shown = trained(paper_config(tiny_data, tmp_path / "shown", **steps, hide_unseen=False))
    first, second = (newest_state(one.checkpoint_dir)["pipeline"] for one in (trainer, shown))
    logit, plain = (state["_model.avatar.blendshapes.opacity_logit"] for state in (first, second))
    seen = first["_model.avatar.color_initialized"]
    assert 0 < int(seen.sum()) < len(seen)
    assert (logit[~seen].sigmoid() < 0.01 * MIN_ALPHA).all()
    assert (plain[~seen].sigmoid() > MIN_ALPHA).any()
    assert torch.equal(logit[seen], plain[seen])


def test_a_run_that_was_finished_and_goes_on_equals_one_that_was_not(
    tiny_data: Path, tmp_path: Path
):
    """What was hidden, or had its colour after the last step, is trained on as it was before."""
    whole = trained(paper_config(tiny_data, tmp_path / "whole", max_num_iterations=20))
    first = trained(paper_config(tiny_data, tmp_path / "first", max_num_iterations=5))
    state = newest_state(first.checkpoint_dir)
    now, before = state["pipeline"], state["before_end"]
    logit, seen = (f"_model.avatar.{n}" for n in ("blendshapes.opacity_logit", "color_initialized"))
    assert 0 < int(before["color_initialized"].sum()) < int(now[seen].sum()) < len(now[seen])
    assert not now[logit].equal(before["blendshapes.opacity_logit"])
    resume = {"max_num_iterations": 20, "load_dir": first.checkpoint_dir}
    again = trained(paper_config(tiny_data, tmp_path / "again", **resume))
    ends = [newest_state(one.checkpoint_dir) for one in (whole, again)]
    for part in ("pipeline", "before_end"):
        tensors = {k: v for k, v in ends[0][part].items() if isinstance(v, torch.Tensor)}
        assert all(value.equal(ends[1][part][name]) for name, value in tensors.items()), part


def test_a_finished_run_that_has_no_steps_left_is_finished_still(tiny_data: Path, tmp_path: Path):
    first = trained(paper_config(tiny_data, tmp_path / "first", max_num_iterations=5))
    resume = {"max_num_iterations": 5, "load_dir": first.checkpoint_dir}
    for folder in ("first", "other"):
        again = trained(paper_config(tiny_data, tmp_path / folder, **resume))
        ends = [newest_state(one.checkpoint_dir)["pipeline"] for one in (first, again)]
        assert all(v.equal(ends[1][k]) for k, v in ends[0].items() if isinstance(v, torch.Tensor))


def test_nothing_of_ours_is_in_it(tiny_data: Path, tmp_path: Path):
    trainer = trained(paper_config(tiny_data, tmp_path, max_num_iterations=3))
    model = trainer.pipeline.model
    assert model.prior is None
    # Theta is taken as it is, however far from the film.
    avatar = model.avatar
    assert not avatar.theta_low.isfinite().any()
    far = torch.full((1, avatar.layout.size), 3.0)
    features = avatar.layout.network_features(far, True, False)
    network = avatar.weight_network
    assert network is not None
    torch.testing.assert_close(avatar.weights(far), network(features))


def test_hiding_asks_for_first_colors(tiny_data: Path, tmp_path: Path):
    config = paper_config(tiny_data, tmp_path, initialize_colors=False)
    with pytest.raises(UserError, match="first colour") as refusal:
        make_trainer(config)
    assert "--pipeline.model.hide-unseen" in refusal.value.remedy


def test_its_learning_rates_stay(tiny_data: Path, tmp_path: Path):
    trainer = trained(paper_config(tiny_data, tmp_path, max_num_iterations=3))
    rates = {name: o.param_groups[0]["lr"] for name, o in trainer.optimizers.optimizers.items()}
    assert math.isclose(rates["position"], 8e-4)
    assert math.isclose(rates["basis_position"], 8e-4 * 0.05)
