"""What weights a fresh model begins with."""

from rgbavatar_ns.avatar.model.weight_network import FIRST_DEVIATION
from rgbavatar_ns.plugin.methods import rgbavatar, rgbavatar_paper
from tests.plugin.run import make_trainer, small_config
from tests.plugin.tiny import NUM_FRAMES, NUM_TEST


def _first_weights(data, output, first_weights):
    model = make_trainer(small_config(data, output, first_weights=first_weights)).pipeline.model
    return model.avatar.weights(model.frame_theta).double().detach()


def test_weights_begin_spread_over_the_training_frames_alone(tiny_data, tmp_path):
    psi = _first_weights(tiny_data, tmp_path / "spread", "spread")
    trained = psi[: NUM_FRAMES - NUM_TEST]
    # Two numbers of theta move in this film; two weights at least follow.
    spread = (trained.std(0, correction=0) / FIRST_DEVIATION - 1).abs() < 1e-3
    assert spread[:2].all()
    assert trained[:, :2].mean(0).abs().max() < 1e-5
    assert psi[:, :2].mean(0).abs().max() > 1e-3
    drawn = _first_weights(tiny_data, tmp_path / "drawn", "drawn")
    assert drawn.std(0).max() < FIRST_DEVIATION


def test_the_papers_preset_draws_them_and_ours_spreads():
    assert rgbavatar_paper.config.pipeline.model.first_weights == "drawn"
    assert rgbavatar.config.pipeline.model.first_weights == "spread"
