"""A head of 81 vertices in FLAME's convention: a curved sheet that faces the camera."""

import numpy as np
import torch

from rgbavatar_ns.head import HeadArrays, HeadModel
from rgbavatar_ns.kernels import PinholeCameras
from tests.head.synthetic_head import grid_faces

SIDE = 9
NUM_IDENTITY, NUM_EXPRESSION = 2, 4


def small_head_arrays() -> HeadArrays:
    """A 16 cm sheet, bulging 4 cm towards +z, whose UV map is its own grid."""
    rng = np.random.default_rng(7)
    axis = np.linspace(-1, 1, SIDE)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    v_template = np.stack([0.08 * x, 0.08 * y, 0.04 * (1 - 0.5 * (x**2 + y**2))], 1)
    faces = grid_faces(SIDE)
    num_vertices = len(v_template)
    waves = [np.sin((k + 1) * x + k) * np.cos((k + 2) * y) for k in range(6)]
    shapedirs = np.stack([w[:, None] * [0.2, 0.3, 1.0] for w in waves], 2) * 0.01
    shares = np.stack([0 * x, 1 + 0 * x, np.clip(-y, 0, 1), 0 * x, 0 * x], 1)
    joint_regressor = np.abs(rng.normal(size=(5, num_vertices)))
    uv = 0.5 + 0.45 * np.stack([x, y], 1)
    return HeadArrays(
        v_template=v_template.astype(np.float32),
        shapedirs=shapedirs.astype(np.float32),
        num_identity=NUM_IDENTITY,
        posedirs=(1e-4 * rng.normal(size=(num_vertices, 3, 36))).astype(np.float32),
        joint_regressor=np.float32(joint_regressor / joint_regressor.sum(1, keepdims=True)),
        parents=np.array([-1, 0, 1, 1, 1], dtype=np.int64),
        skinning_weights=(shares / shares.sum(1, keepdims=True)).astype(np.float32),
        faces=faces,
        uv=uv.astype(np.float32),
        uv_faces=faces,
        expression_names=tuple(f"wave{k}" for k in range(NUM_EXPRESSION)),
        eyelid_dirs=None,
        vertex_groups={"skin": np.arange(num_vertices)},
        name="small",
    )


def small_head(dtype: torch.dtype = torch.float32) -> HeadModel:
    return HeadModel(small_head_arrays()).to(dtype)


def small_identity(dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.tensor([0.4, -0.7], dtype=dtype)


def front_camera(size: int = 32, dtype: torch.dtype = torch.float32) -> PinholeCameras:
    """A camera half a metre in front, seeing the head upright (OpenCV axes)."""
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=dtype))[None].clone()
    world_to_camera[0, 2, 3] = 0.5
    return PinholeCameras(
        world_to_camera=world_to_camera,
        focal_px=torch.full((1, 2), 2.0 * size, dtype=dtype),
        principal_point_px=torch.full((1, 2), size / 2, dtype=dtype),
        width=size,
        height=size,
    )


def random_theta(layout, batch: int, seed: int = 0, dtype: torch.dtype = torch.float32):
    """Expressions of order 1, rotations of order .2 rad, translations of order 2 cm."""
    generator = torch.Generator().manual_seed(seed)
    scales = {"linear": 0.7, "axis_angle": 0.15, "translation": 0.02}
    parts = {
        field.name: scales[field.form]
        * torch.randn(batch, field.size, generator=generator, dtype=dtype)
        for field in layout.fields
    }
    return layout.join(parts)


RANDOM_AMOUNTS = {
    "position": 3e-3,
    "rotation": 0.4,
    "log_scale": 0.4,
    "opacity": 1.0,
    "color": 1.0,
    "basis_position": 2e-3,
    "basis_rotation": 0.2,
    "basis_color": 0.5,
}


def randomize(avatar, seed: int = 0, amounts=RANDOM_AMOUNTS, most: float = torch.inf) -> None:
    """Move every Gaussian off its initial values, bases included, by up to `most` amounts."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameters in avatar.parameter_groups().items():
            for parameter in parameters:
                noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
                noise = noise.clamp(-most, most).to(parameter.dtype)
                parameter.add_(amounts.get(name, 0.0) * noise)
