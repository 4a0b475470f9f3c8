"""Orthogonal bases as an option of the method."""

from pathlib import Path

import pytest

from rgbavatar_ns.avatar.training import step as step_module
from rgbavatar_ns.avatar.training.orthogonality import orthogonality_error
from tests.plugin.run import small_config, trained


def _trained(data: Path, output: Path, kind: str, steps: int = 8):
    config = small_config(data, output, max_num_iterations=steps)
    config.pipeline.model.orthogonality = kind
    return trained(config).pipeline.model


@pytest.mark.parametrize("kind", ["qr", "gram_schmidt"])
def test_bases_are_made_orthogonal_at_the_interval(
    tiny_data: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(step_module, "ORTHOGONALIZE_EVERY", 4)
    at_the_interval = _trained(tiny_data, tmp_path / "a", kind)
    assert orthogonality_error(at_the_interval.avatar.blendshapes) < 1e-5
    beyond = _trained(tiny_data, tmp_path / "b", kind, steps=10)
    assert orthogonality_error(beyond.avatar.blendshapes) > 1e-5


def test_the_loss_counts_and_needs_the_readable_path(tiny_data: Path, tmp_path: Path):
    free = _trained(tiny_data, tmp_path / "free", "free", steps=20)
    config = small_config(tiny_data, tmp_path / "loss", max_num_iterations=20)
    config.pipeline.model.orthogonality = "loss"
    trainer = trained(config)
    pipeline = trainer.pipeline
    step = pipeline.training_step(trainer.optimizers)
    assert (step.kind, "orthogonal" in step.reason) == ("eager", True)
    assert set(step(pipeline.training_batch(20, step.kind), 20)) == {"l1", "orthogonality"}
    bound = pipeline.model
    errors = [orthogonality_error(model.avatar.blendshapes).item() for model in (free, bound)]
    assert errors[1] < errors[0]
