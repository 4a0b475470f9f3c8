"""A small method: Gaussians upon triangles, and a network that has no row for each."""

import torch
from torch import Tensor, nn

from rgbavatar_ns.avatar.methods.density import (
    ControlledGaussians,
    ScreenStatistics,
    sampled_positions,
)
from rgbavatar_ns.avatar.methods.gaussian_rows import GaussianRows
from rgbavatar_ns.kernels import GaussianSet

ROWS = (
    "position",
    "rotation_wxyz",
    "log_scale",
    "opacity_logit",
    "color",
    "triangle_of",
    "statistics",
)
PARAMETERS = ROWS[:5]


class Splats(nn.Module):
    """Random Gaussians; all opaque and smaller than a centimetre, so that nothing is due."""

    def __init__(self, count: int = 12, seed: int = 0, triangles: int = 4) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)

        def normal(*size: int) -> Tensor:
            return torch.randn(*size, generator=generator)

        self.position = nn.Parameter(0.3 * normal(count, 3))
        self.rotation_wxyz = nn.Parameter(normal(count, 4))
        self.log_scale = nn.Parameter(0.2 * normal(count, 3) - 6)
        self.opacity_logit = nn.Parameter(0.5 * normal(count))
        self.color = nn.Parameter(normal(count, 2, 3))
        self.register_buffer("triangle_of", torch.arange(count) % triangles)
        self.statistics = ScreenStatistics(count)
        self.network = nn.Linear(count, count)
        self.rows = GaussianRows(self, ROWS)

    def controlled(self, face_size_m: Tensor | None = None, **names: str) -> ControlledGaussians:
        """As density control takes them; sizes of triangles scale what they carry."""

        def world_scale_m() -> Tensor:
            scale = self.log_scale.detach().exp()
            return scale if face_size_m is None else scale * face_size_m[self.triangle_of][:, None]

        def split(chosen: Tensor, samples: Tensor) -> dict[str, Tensor]:
            place = sampled_positions(
                self.position[chosen],
                self.rotation_wxyz[chosen],
                self.log_scale[chosen].exp(),
                samples,
            )
            return {"position": place}

        return ControlledGaussians(self.rows, self.statistics, world_scale_m, split, **names)

    def gaussian_set(self) -> GaussianSet:
        """What is drawn."""
        return GaussianSet(
            self.position[None],
            self.rotation_wxyz[None],
            self.log_scale.exp()[None],
            self.opacity_logit.sigmoid()[None],
            self.color[None, :, 0].sigmoid(),
        )


def adam(module: nn.Module, fused: bool = True) -> torch.optim.Adam:
    """A group for each parameter, as methods have it."""
    groups = [{"params": [p], "lr": 0.01, "name": n} for n, p in module.named_parameters()]
    return torch.optim.Adam(groups, eps=1e-15, fused=fused)


def learn(module: nn.Module, optimizer: torch.optim.Optimizer, steps: int, seed: int = 0) -> None:
    """Steps with random gradients of every parameter."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        for parameter in module.parameters():
            parameter.grad = torch.randn(parameter.shape, generator=generator)
        optimizer.step()
        optimizer.zero_grad()


def moments(optimizer: torch.optim.Optimizer, parameter: Tensor) -> list[Tensor]:
    """Adam's two."""
    return [optimizer.state[parameter][name] for name in ("exp_avg", "exp_avg_sq")]


def everything(module: nn.Module, optimizer: torch.optim.Optimizer) -> list[Tensor]:
    """Copies of all that a change could change."""
    tensors = [*module.parameters(), *module.buffers()]
    tensors += [v for p in module.parameters() for v in optimizer.state[p].values()]
    return [tensor.detach().clone() for tensor in tensors]


def all_equal(first: list[Tensor], second: list[Tensor]) -> bool:
    """Bit for bit."""
    return len(first) == len(second) and all(map(torch.equal, first, second))
