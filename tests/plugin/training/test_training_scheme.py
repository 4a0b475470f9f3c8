"""The paper's training schemes: they differ in how a batch is drawn, not in its gradients."""

from pathlib import Path

import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from tests.plugin.run import make_trainer, small_config, trained


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many images each rendering had."""
    counts: list[int] = []
    original = Avatar.render

    def counted(self, theta, *arguments, **options):
        counts.append(len(theta))
        return original(self, theta, *arguments, **options)

    monkeypatch.setattr(Avatar, "render", counted)
    return counts


def _gradients(data: Path, output: Path, *, batch_parallel: bool) -> dict[str, torch.Tensor]:
    """Of the second step, where the bases are no longer zero; that of theta too."""
    fields = {"batch_parallel": batch_parallel, "refine_tracking": True, "fast": False}
    trainer = make_trainer(small_config(data, output, **fields))
    model = trainer.pipeline.model
    # The same place for both, away from where everything begins.
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in model.avatar.parameters():
            parameter += 0.01 * torch.randn(parameter.shape, generator=generator)
    pipeline = trainer.pipeline
    batch = pipeline.training_batch(0, "eager")
    assert batch.background is not None
    theta = batch.theta.clone().requires_grad_()
    losses = pipeline.training_step(trainer.optimizers).eager_losses(
        batch, theta, batch.background, 0
    )
    losses["l1"].backward()
    gradients = {name: p.grad for name, p in model.avatar.named_parameters()}
    gradients["theta"] = theta.grad
    assert all(gradient is not None for gradient in gradients.values())
    return {name: gradient for name, gradient in gradients.items() if gradient is not None}


def test_a_naive_batch_has_the_gradients_of_the_parallel_one(
    tiny_data: Path, tmp_path: Path, drawn: list[int]
):
    together = _gradients(tiny_data, tmp_path / "a", batch_parallel=True)
    assert drawn == [4]
    drawn.clear()
    singly = _gradients(tiny_data, tmp_path / "b", batch_parallel=False)
    assert drawn == [1] * 4
    for name, gradient in together.items():
        assert gradient.norm() > 0, name
        assert (gradient - singly[name]).norm() < 1e-5 * gradient.norm(), name


def test_a_naive_batch_is_never_fused_and_only_slower_in_training(
    tiny_data: Path, tmp_path: Path, drawn: list[int]
):
    fields = {"batch_parallel": False, "max_num_iterations": 2}
    trainer = trained(small_config(tiny_data, tmp_path, **fields))
    assert drawn[:4] == [1] * 4
    drawn.clear()
    model = trainer.pipeline.model.eval()
    with torch.no_grad():
        model.get_outputs(trainer.pipeline.datamanager.next_train(0)[0])
    assert drawn == [4]
