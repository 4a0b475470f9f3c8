"""Orthogonal bases as an option of the method."""

from collections.abc import Callable

import pytest

from rgbavatar_ns.avatar.training import step as step_module
from rgbavatar_ns.avatar.training.orthogonality import orthogonality_error
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainer


def _error(trainer: RGBAvatarTrainer) -> float:
    return orthogonality_error(trainer.pipeline.model.avatar.blendshapes).item()


@pytest.mark.parametrize("kind", ["qr", "gram_schmidt"])
def test_bases_are_made_orthogonal_at_the_interval(
    train: Callable[..., RGBAvatarTrainer], kind: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(step_module, "ORTHOGONALIZE_EVERY", 4)
    at_the_interval, beyond = (
        train(str(steps), orthogonality=kind, max_num_iterations=steps) for steps in (8, 10)
    )
    assert _error(at_the_interval) < 1e-5
    assert _error(beyond) > 1e-5


def test_the_loss_counts_and_needs_the_readable_path(train: Callable[..., RGBAvatarTrainer]):
    free = train("free", orthogonality="free")
    trainer = train("loss", orthogonality="loss")
    pipeline = trainer.pipeline
    step = pipeline.training_step(trainer.optimizers)
    assert (step.kind, "orthogonal" in step.reason) == ("eager", True)
    assert set(step(pipeline.training_batch(20, step.kind), 20)) == {"l1", "orthogonality"}
    assert _error(trainer) < _error(free)
