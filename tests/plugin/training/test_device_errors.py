"""What a GPU cannot do ends training with cause and remedy; the checkpoints stay whole."""

from collections.abc import Callable

import pytest
import torch

from rgbavatar_ns.avatar.storage.checkpoint_file import list_checkpoints, read_checkpoint
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import DeviceError
from rgbavatar_ns.plugin.training.trainer import RGBAvatarTrainerConfig
from tests.plugin.run import make_trainer

ERRORS = {
    "out of memory": (
        torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
        "memory is full.*device-mib 0.*batch-size",
    ),
    "no such architecture": (
        DeviceError("The kernels need a GPU of architecture sm_75.", "Use another GPU."),
        "sm_75.*Use another GPU",
    ),
}
if hasattr(torch, "AcceleratorError"):
    lost = torch.AcceleratorError("CUDA error: unspecified launch failure\nCompile with ...")
    ERRORS["a lost device"] = (
        lost,
        r"failed: CUDA error: unspecified launch failure\. Start again",
    )


@pytest.mark.parametrize("name", ERRORS)
def test_the_reason_is_told_and_checkpoints_stay(
    name: str, config_of: Callable[..., RGBAvatarTrainerConfig], monkeypatch: pytest.MonkeyPatch
):
    error, message = ERRORS[name]
    trainer = make_trainer(config_of(max_num_iterations=9, steps_per_save=2))
    batch = trainer.pipeline.training_batch

    def fails_later(step, kind):
        if step == 5:
            raise error
        return batch(step, kind)

    monkeypatch.setattr(trainer.pipeline, "training_batch", fails_later)
    with pytest.raises(UserError, match=message) as told:
        trainer.train()
    assert str(trainer.checkpoint_dir) in told.value.remedy
    step, path = list_checkpoints(trainer.checkpoint_dir)[-1]
    assert read_checkpoint(path)["step"] == step == 4
