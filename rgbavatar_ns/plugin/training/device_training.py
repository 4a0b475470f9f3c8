"""Training that the device does by itself: all frames lie there, and a step is one CUDA graph."""

from collections.abc import Iterable

import torch

from rgbavatar_ns.avatar.training.cuda_graph import Recorder, supports
from rgbavatar_ns.avatar.training.recorded_step import RecordedStep
from rgbavatar_ns.plugin.cameras import from_nerfstudio
from rgbavatar_ns.plugin.datamanager import RGBAvatarDataManager
from rgbavatar_ns.plugin.model import RGBAvatarModel


def recorded_step(
    model: RGBAvatarModel,
    datamanager: RGBAvatarDataManager,
    optimizers: Iterable[torch.optim.Optimizer],
    recorder: Recorder,
) -> RecordedStep | None:
    """Return the step that needs nothing from the host, or None where there is none.

    There is none on a CPU, while tracking is refined, for a stream, whose frames come and go, and
    where the images are beyond the device's budget.
    """
    if model.refinement is not None or len(datamanager.train_dataset) == 0:
        return None
    camera = datamanager.train_dataset.cameras[torch.tensor([0])].to(model.device)
    theta = (camera.metadata or {})["theta"]
    if not supports(model.avatar, theta, from_nerfstudio(camera), model.config.rasterizer):
        return None
    frames = datamanager.device_frames()
    if frames is None:
        return None
    batch_size = len(datamanager.next_choice(0)[0])
    return RecordedStep(
        model.avatar,
        optimizers,
        frames,
        batch_size,
        backend=model.config.rasterizer,
        recorder=recorder,
    )
