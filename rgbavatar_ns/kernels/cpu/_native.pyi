from torch import Tensor

def instruction_sets() -> list[str]: ...
def constants() -> dict[str, float | tuple[int, ...]]: ...
def mean_similarity(
    image: Tensor,
    target: Tensor,
    window: Tensor,
    c1: float,
    c2: float,
    gradient: Tensor | None,
    threads: int,
    instruction_set: str,
) -> list[float]: ...
def harmonic_colors(
    coefficients: Tensor, directions: Tensor, colors: Tensor, threads: int, instruction_set: str
) -> None: ...
def harmonic_gradient(
    coefficients: Tensor,
    directions: Tensor,
    color_gradient: Tensor,
    coefficient_gradient: Tensor,
    direction_gradient: Tensor,
    threads: int,
    instruction_set: str,
) -> None: ...

class Gaussians:
    def __init__(
        self,
        means: Tensor,
        quats_wxyz: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        screen_offset: Tensor | None = None,
    ) -> None: ...

class PackedDrawing:
    def draw(
        self, background: Tensor, first: int, image: Tensor, alpha: Tensor, depth: Tensor | None
    ) -> None: ...

class _Drawing(PackedDrawing):
    def average(
        self,
        images: Tensor | None,
        weighted_sum: Tensor | None,
        weight_sum: Tensor | None,
        max_weight: Tensor,
    ) -> None: ...

class Session(_Drawing):
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
    def backward(
        self,
        gaussians: Gaussians,
        background: Tensor,
        image_grad: Tensor | None,
        alpha_grad: Tensor | None,
        threads: int,
        means: Tensor,
        quats_wxyz: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        screen_offset: Tensor | None = None,
    ) -> None: ...

class Morphed:
    def __init__(
        self,
        position: Tensor,
        rotation_wxyz: Tensor,
        color_feature: Tensor,
        log_scale: Tensor,
        opacity_logit: Tensor,
        basis_position: Tensor | None,
        basis_rotation_wxyz: Tensor | None,
        basis_color_feature: Tensor | None,
        barycentric: Tensor,
        edges_to_frame: Tensor,
        rest_length: Tensor | None,
        triangle_vertices: Tensor,
        triangle_of: Tensor,
        variant: int,
    ) -> None: ...

class MorphedSession(_Drawing):
    def __init__(
        self,
        blended: Morphed,
        weights: Tensor,
        vertices: Tensor,
        world_to_camera: Tensor,
        focal_px: Tensor,
        principal_point_px: Tensor,
        width: int,
        height: int,
        threads: int,
        instruction_set: str,
    ) -> None: ...
    def forward_loss(
        self,
        images_rgba: Tensor,
        background: Tensor,
        known: Tensor | None = None,
        sums: Tensor | None = None,
        threshold: float = 0.0,
        sight_images: int = 0,
        over_background: bool = False,
    ) -> tuple[float, list[int]]: ...
    def backward_adam(
        self,
        groups: list[tuple[Tensor, Tensor, Tensor, tuple[float, ...]]],
        weight_gradient: Tensor,
        vertex_gradient: Tensor | None = None,
    ) -> None: ...

class Packed:
    def __init__(
        self, blended: Morphed, weights: Tensor, vertices: Tensor, threads: int
    ) -> None: ...
    @property
    def count(self) -> int: ...
    @property
    def bytes(self) -> int: ...

class PackedSession(PackedDrawing):
    def __init__(
        self,
        packed: Packed,
        weights: Tensor,
        vertices: Tensor,
        world_to_camera: Tensor,
        focal_px: Tensor,
        principal_point_px: Tensor,
        width: int,
        height: int,
        threads: int,
        instruction_set: str,
    ) -> None: ...

class Posing:
    def __init__(
        self,
        parts: tuple[int, int, int, int, int, int],
        joints: tuple[int, ...],
        parents: tuple[int, ...],
        rest: Tensor,
        directions: Tensor,
        joints_at_rest: Tensor,
        joint_directions: Tensor,
        skinning: Tensor,
        only_joints: bool,
        low: Tensor,
        high: Tensor,
        features: list[tuple[int, int, bool]],
        layers: list[tuple[Tensor, Tensor]],
    ) -> None: ...
    @property
    def num_weights(self) -> int: ...
    @property
    def num_vertices(self) -> int: ...
    def run(
        self, theta: Tensor, weights: Tensor, vertices: Tensor, threads: int, instruction_set: str
    ) -> None: ...
