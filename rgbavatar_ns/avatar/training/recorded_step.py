"""The whole optimiser step as one CUDA graph: the host says which frames, and waits for nothing.

Frames lie on the device as 8-bit images, with their heads, which are made once. A replay takes what
changes from step to step (frames, backgrounds, Adam's numbers) from one small buffer; morphing,
drawing, loss, gradients, Adam and the weight network with its own gradients and Adam are in the
graph.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.training.batches import DeviceFrames
from rgbavatar_ns.avatar.training.color_init import FirstColors
from rgbavatar_ns.avatar.training.cuda_graph import (
    Recorder,
    Recording,
    lane,
    record_cuda_graph,
    supports,
)
from rgbavatar_ns.avatar.training.frame_heads import FrameHeads
from rgbavatar_ns.avatar.training.optimizer_states import AdamStates
from rgbavatar_ns.kernels import CAMERA_TENSORS, UPDATED_ATTRIBUTES, DeviceRenderer

_NUMBERS = 5
_EAGER_STEPS = 3
"""Steps before the recording: libraries make their handles, and the lists' room is measured."""
_LOOK_EVERY = 200
"""Steps between two looks at how many overflowed."""


class RecordedStep:
    """Trains an avatar with torch's Adam optimisers on frames that lie on its device.

    The first steps run kernel by kernel, then the step is recorded. A step whose tiles' lists do
    not fit changes no Gaussian; `skipped_steps` counts them, and the step is recorded anew with
    more room. Raises ValueError where the optimisers cannot be used (`unsupported_reason`), or the
    backend needs the host (`supports`).
    """

    def __init__(
        self,
        avatar: Avatar,
        optimizers: Iterable[torch.optim.Optimizer],
        frames: DeviceFrames,
        batch_size: int,
        *,
        backend: str = "auto",
        first_colors: FirstColors | None = None,
        num_filmed: int = 0,
        recorder: Recorder = record_cuda_graph,
    ) -> None:
        self._avatar, self.frames, self._backend = avatar, frames, backend
        self._first_colors, self._num_filmed = first_colors, num_filmed
        self._states = AdamStates(avatar, optimizers)
        self._heads = FrameHeads(avatar)
        self._recording = Recording(avatar, self._work, recorder, self._read)
        self._lane = lane(frames.theta.device)
        self._optimizers_told = False
        self._overflows_read: Callable[[], list[int] | None] | None = None
        self._steps = self.skipped_steps = 0
        device = frames.theta.device
        self._network = avatar.parameter_groups().get("weight_network", [])
        rows = len(UPDATED_ATTRIBUTES) + 1
        # One buffer, so that one copy brings a step's inputs: frames, backgrounds, Adam's numbers.
        self._sizes = (batch_size, 3 * batch_size, rows * 2 * _NUMBERS)
        self._step_inputs = torch.zeros(sum(self._sizes), dtype=torch.float64, device=device)
        self._rows = torch.arange(len(frames.theta), device=device)
        self._loss = torch.zeros((), device=device)
        self._overflows = torch.zeros((), dtype=torch.int64, device=device)
        self._needed = torch.zeros((), dtype=torch.int32, device=device)
        first = frames.cameras.select([0])
        if not supports(avatar, frames.theta[:1], first, backend):
            raise ValueError("This backend's steps need the host. Use FusedStep.")

    def __call__(
        self, chosen: Sequence[int], background: Float[Tensor, "B 3"]
    ) -> Float[Tensor, ""]:
        """Take one step on `chosen`, backgrounds in main memory; ValueError for another size."""
        if len(chosen) != self._sizes[0] or len(background) != len(chosen):
            raise ValueError(f"{len(chosen)} frames in a step recorded for {self._sizes[0]}.")
        with self._lane():
            self._heads.know(self.frames.theta)
            self._gaussian_states = self._states.next_of_gaussians()
            self._network_states = self._states.next_of_network()
            if not self._optimizers_told:
                self._tell_optimizers()
            news = [*map(float, chosen), *background.flatten().tolist(), *self._numbers()]
            # torch keeps pinned memory until the copy is done, however far ahead the host is.
            row = torch.tensor(news, dtype=torch.float64, pin_memory=self._loss.is_cuda)
            self._step_inputs.copy_(row, non_blocking=True)
            if self._steps < _EAGER_STEPS:
                self._work()
            else:
                self._recording()
        self._states.recount_all()
        self._steps += 1
        if self._steps % _LOOK_EVERY == 0 and self._overflows_read is None:
            numbers = torch.stack([self._overflows, self._needed.long()])
            self._overflows_read = self._renderer_of_last_step.read_later(numbers)
        self._look()
        return self._loss.clone()

    def _tell_optimizers(self) -> None:
        """A step without gradients changes nothing; schedules ask that there was one."""
        for optimizer in self._states.optimizers:
            optimizer.zero_grad(set_to_none=True)
            optimizer.step()
        self._optimizers_told = True

    def _read(self) -> list[Tensor]:
        """What a recorded step reads beside the avatar: Adam's state and the frames."""
        states = [*self._gaussian_states.values(), *self._network_states]
        moments = [t for s in states for t in (s.first_moment, s.second_moment)]
        frames, cameras = self.frames, self.frames.cameras
        filmed = [frames.theta, frames.images_rgba, cameras.world_to_camera]
        seen = [cameras.focal_px, cameras.principal_point_px]
        filmed += [self._heads.vertices, self._heads.features]
        return [*moments, *self._states.steps(), *filmed, *seen]

    def _numbers(self) -> list[float]:
        """Adam's numbers, row by row: base and bases of each attribute, then the network's."""
        states, numbers = self._gaussian_states, []
        for name in UPDATED_ATTRIBUTES:
            for key in (name, f"basis_{name}"):
                numbers += states[key].step_numbers() if key in states else (0.0,) * _NUMBERS
        network = self._network_states
        numbers += network[0].step_numbers() if network else (0.0,) * _NUMBERS
        return [*numbers, *(0.0,) * _NUMBERS]

    def _work(self) -> None:
        """One step from its inputs: nothing here may wait for the device or copy from the host."""
        chosen, background, numbers = self._step_inputs.split(self._sizes)
        rows = numbers.float().view(-1, 2 * _NUMBERS)
        index = chosen.long()
        renderer, psi = self._renderer(index)
        images, behind = self.frames.images_rgba, background.float().view(-1, 3)
        sight = self._first_colors.sight(self._num_filmed) if self._first_colors else None
        self._loss.copy_(renderer.forward_loss_of(images, index, behind, sight))
        gradient = renderer.backward_adam_with(self._gaussian_states, rows[:-1])
        if self._network:
            grads = torch.autograd.grad(psi, self._network, gradient.weights)
            for state, grad in zip(self._network_states, grads):
                renderer.update_parameter(state, grad, rows[-1])
        if self._first_colors is not None and sight is not None:
            self._first_colors.give(sight)
        self._states.add_one_to_all()
        self._overflows += renderer.overflowed
        torch.maximum(self._needed, renderer.needed, out=self._needed)
        self._renderer_of_last_step = renderer

    def renderer_of(self, row: int) -> DeviceRenderer:
        """What draws one of the frames as the avatar is now."""
        self._heads.know(self.frames.theta)
        return self._renderer(self._rows[row : row + 1])[0]

    def _renderer(self, index: Tensor) -> tuple[DeviceRenderer, Tensor]:
        frames = self.frames
        theta, cameras = frames.theta.index_select(0, index), frames.cameras
        if len(cameras.focal_px) > 1:
            chosen = {
                name: getattr(cameras, name).index_select(0, index) for name in CAMERA_TENSORS
            }
            cameras = replace(cameras, **chosen)
        with torch.enable_grad():
            psi = self._avatar.weights_of(self._heads.features.index_select(0, index))
        vertices = self._heads.vertices.index_select(0, index)
        renderer = self._avatar.renderer(
            theta, cameras, psi.detach(), vertices, backend=self._backend
        )
        assert isinstance(renderer, DeviceRenderer)
        return renderer, psi

    def _look(self) -> None:
        """Where steps overflowed, as the device says by and by: count them, and make room.

        The step is recorded anew then.
        """
        known = None if self._overflows_read is None else self._overflows_read()
        if known is None:
            return
        self._overflows_read = None
        overflows, needed = known
        if overflows:
            self.skipped_steps += overflows
            self._overflows -= overflows
            self._renderer_of_last_step.make_room(needed)
            self._recording.forget()
            self._steps = 0
