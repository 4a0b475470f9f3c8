"""PLY files against plyfile and a reader of our own making, not the writer's inverse."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import draw, front_camera, write_ply
from rgbavatar_ns.kernels import GaussianSet, rasterize

from .subject import avatar_of, lively_theta, psnr

# As the 3DGS release writes them; viewers look properties up by name or count on this order.
_STANDARD = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 "
    + " ".join(f"f_rest_{i}" for i in range(45))
    + " opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
).split()


def read_ply(path: Path) -> GaussianSet:
    """As a viewer of 3D Gaussian splatting does: sigmoid, exp, normalise, colour of degree 0."""
    vertex = PlyData.read(str(path))["vertex"]

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([np.asarray(vertex[name]) for name in names], 1))[None]

    quats_wxyz = columns("rot_0", "rot_1", "rot_2", "rot_3")
    return GaussianSet(
        means=columns("x", "y", "z"),
        quats_wxyz=quats_wxyz / quats_wxyz.norm(dim=-1, keepdim=True),
        scales=columns("scale_0", "scale_1", "scale_2").exp(),
        opacities=1 / (1 + (-columns("opacity")[..., 0]).exp()),
        colors=0.5 + 0.28209479177387814 * columns("f_dc_0", "f_dc_1", "f_dc_2"),
    )


def test_plyfile_reads_it_and_it_renders_to_the_same_picture(tmp_path):
    avatar = avatar_of()
    theta = lively_theta(avatar, 1)
    with torch.no_grad():
        count = write_ply(tmp_path / "a.ply", avatar.gaussians(theta))
    assert count == avatar.num_gaussians
    camera = front_camera(avatar, 96, 96)
    background = torch.ones(3)
    ours = draw(avatar, theta, camera, (1.0, 1.0, 1.0)).image[0].numpy()
    theirs = rasterize(read_ply(tmp_path / "a.ply"), camera, background).image[0].numpy()
    assert ours.std() > 0.1
    assert psnr(ours, theirs) > 60


def test_the_columns_are_those_of_the_3dgs_release(tmp_path):
    avatar = avatar_of()
    with torch.no_grad():
        gaussians = avatar.gaussians(lively_theta(avatar, 1))
    write_ply(tmp_path / "a.ply", gaussians)
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert [p.name for p in vertex.properties] == _STANDARD
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    assert not any(np.any(vertex[f"f_rest_{i}"]) for i in range(45))
    # trimesh, another public reader, sees the same points and columns.
    cloud = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_allclose(cloud.vertices, gaussians.means[0].numpy(), rtol=1e-6)
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert list(raw.dtype.names) == _STANDARD
    assert np.array_equal(raw["opacity"].squeeze(), vertex["opacity"])
    rotation = np.stack([vertex[f"rot_{i}"] for i in range(4)], 1)
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, rtol=1e-5)


def test_opacities_and_scales_at_their_limits_stay_finite(tmp_path):
    extreme = GaussianSet(
        means=torch.zeros(1, 2, 3),
        quats_wxyz=torch.tensor([[[2.0, 0, 0, 0], [0, 0, 3.0, 0]]]),
        scales=torch.tensor([[[0.0, 1e-3, 1.0]] * 2]),
        opacities=torch.tensor([[0.0, 1.0]]),
        colors=torch.tensor([[[-1.0, 0.5, 2.0]] * 2]),
    )
    write_ply(tmp_path / "a.ply", extreme)
    read = read_ply(tmp_path / "a.ply")
    assert all(torch.isfinite(value).all() for value in vars(read).values())
    assert torch.allclose(read.opacities, extreme.opacities, atol=1e-5)
    assert torch.allclose(read.scales, extreme.scales, atol=1e-6)
    assert torch.allclose(read.colors, extreme.colors, atol=1e-5)


def test_what_is_no_single_set_or_cannot_be_written_is_refused(tmp_path):
    avatar = avatar_of()
    with torch.no_grad():
        several = avatar.gaussians(lively_theta(avatar, 2))
        one = avatar.gaussians(lively_theta(avatar, 1))
    with pytest.raises(ValueError, match="one set"):
        write_ply(tmp_path / "a.ply", several)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="Cannot write"):
        write_ply(tmp_path / "file" / "a.ply", one)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
