"""Orthogonal bases as an option of the method."""

from pathlib import Path

import pytest

from rgbavatar_ns.avatar.training.orthogonality import orthogonality_error
from rgbavatar_ns.plugin import model as model_module
from tests.plugin.run import make_trainer, small_config


def _trained(data: Path, output: Path, kind: str, steps: int = 8):
    config = small_config(data, output, max_num_iterations=steps)
    config.pipeline.model.orthogonality = kind
    trainer = make_trainer(config)
    trainer.train()
    return trainer.pipeline.model


@pytest.mark.parametrize("kind", ["qr", "gram_schmidt"])
def test_bases_are_made_orthogonal_at_the_interval(
    tiny_data: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(model_module, "_ORTHOGONALIZE_EVERY", 4)
    at_the_interval = _trained(tiny_data, tmp_path / "a", kind)
    assert orthogonality_error(at_the_interval.avatar.blendshapes) < 1e-5
    beyond = _trained(tiny_data, tmp_path / "b", kind, steps=10)
    assert orthogonality_error(beyond.avatar.blendshapes) > 1e-5


def test_the_loss_counts_and_needs_the_readable_path(tiny_data: Path, tmp_path: Path):
    free = _trained(tiny_data, tmp_path / "free", "free", steps=20)
    bound = _trained(tiny_data, tmp_path / "loss", "loss", steps=20)
    assert not bound.can_fuse(0, [])
    losses = bound.get_loss_dict(*_drawn(bound))
    assert set(losses) == {"l1", "orthogonality"}
    errors = [orthogonality_error(model.avatar.blendshapes).item() for model in (free, bound)]
    assert errors[1] < errors[0]


def _drawn(model):
    batch = {"image": model._images_rgba, "background": None, "step": 0}
    cameras = model._cameras
    batch["background"] = (cameras.metadata or {})["background"]
    return model.get_outputs(cameras), batch
