"""Orthogonal bases as an option of the method."""

from collections.abc import Callable

import pytest

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.avatar.prior.surface_prior import SurfacePrior
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


def test_bases_that_the_surface_draws_in_the_same_step_are_orthogonal_too(
    train: Callable[..., RGBAvatarTrainer], monkeypatch: pytest.MonkeyPatch
):
    def pull(prior: SurfacePrior, avatar: Avatar, step: int) -> None:
        basis = avatar.blendshapes.basis_position.data
        basis += basis.roll(1, 0)

    monkeypatch.setattr(step_module, "ORTHOGONALIZE_EVERY", 8)
    monkeypatch.setattr(SurfacePrior, "due", lambda prior, step: prior.has_begun and step == 7)
    monkeypatch.setattr(SurfacePrior, "pull", pull)
    options = {"surface_prior": True, "hide_unseen": False, "max_num_iterations": 8}
    assert _error(train("free", **options)) > 0.1
    assert _error(train("qr", orthogonality="qr", **options)) < 1e-5


def test_the_loss_counts_and_needs_the_readable_path(train: Callable[..., RGBAvatarTrainer]):
    free = train("free", orthogonality="free")
    trainer = train("loss", orthogonality="loss")
    pipeline = trainer.pipeline
    step = pipeline.training_step(trainer.optimizers)
    assert (step.kind, "orthogonal" in step.reason) == ("eager", True)
    assert set(step(pipeline.training_batch(20, step.kind), 20)) == {"l1", "orthogonality"}
    assert _error(trainer) < _error(free)
