from torch import Tensor

def instruction_sets() -> list[str]: ...
def constants() -> dict[str, float]: ...

class Gaussians:
    def __init__(
        self, means: Tensor, quats_wxyz: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
    ) -> None: ...

class Session:
    def __init__(
        self,
        gaussians: Gaussians,
        world_to_camera: Tensor,
        focal_px: Tensor,
        principal_point_px: Tensor,
        batch: int,
        width: int,
        height: int,
        threads: int,
        instruction_set: str,
    ) -> None: ...
    def draw(
        self, background: Tensor, image: Tensor, alpha: Tensor, depth: Tensor | None
    ) -> None: ...
    def average(
        self,
        images: Tensor | None,
        weighted_sum: Tensor | None,
        weight_sum: Tensor | None,
        max_weight: Tensor,
    ) -> None: ...
    def backward(
        self,
        gaussians: Gaussians,
        image: Tensor,
        alpha: Tensor,
        image_grad: Tensor | None,
        alpha_grad: Tensor | None,
        means: Tensor,
        quats_wxyz: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        threads: int,
    ) -> None: ...
