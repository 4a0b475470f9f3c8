"""Gaussians for other programs: each format against a reader of others, or by its text."""

import gzip
import importlib
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData

from rgbavatar_ns.cli.export import Format
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import (
    GAUSSIAN_FILES,
    front_camera,
    write_gaussian_sequence,
    write_gaussians,
    write_gltf,
    write_ply,
)
from rgbavatar_ns.kernels import GaussianSet, rasterize

from .glb import read_glb
from .subject import avatar_of, lively_theta, psnr
from .test_ply import read_ply

_COMPRESSED = [name for name in GAUSSIAN_FILES if name not in ("ply", "gltf")]


def _gaussians() -> GaussianSet:
    avatar = avatar_of()
    with torch.no_grad():
        return avatar.gaussians(lively_theta(avatar, 1))


def test_the_command_names_each_of_them():
    assert set(GAUSSIAN_FILES) <= set(Format.__args__)


def test_gltf_holds_what_the_ply_holds(tmp_path):
    gaussians = _gaussians()
    assert write_gltf(tmp_path / "a.glb", gaussians) == gaussians.means.shape[1]
    write_ply(tmp_path / "a.ply", gaussians)
    described, found = read_glb(tmp_path / "a.glb")
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]

    def columns(*names: str) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], np.float64) for name in names], 1)

    wanted = {
        "POSITION": columns("x", "y", "z"),
        "KHR_gaussian_splatting:ROTATION": columns("rot_1", "rot_2", "rot_3", "rot_0"),
        "KHR_gaussian_splatting:SCALE": np.exp(columns("scale_0", "scale_1", "scale_2")),
        "KHR_gaussian_splatting:OPACITY": 1 / (1 + np.exp(-columns("opacity"))),
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": columns("f_dc_0", "f_dc_1", "f_dc_2"),
    }
    assert set(found) == set(wanted)
    for name, values in wanted.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-5, atol=1e-7, err_msg=name)
    position = described["accessors"][0]
    assert position["min"] == found["POSITION"].min(0).tolist()
    assert position["max"] == found["POSITION"].max(0).tolist()


def test_gltf_says_what_the_extension_asks_for(tmp_path):
    write_gltf(tmp_path / "a.glb", _gaussians())
    described, found = read_glb(tmp_path / "a.glb")
    assert described["extensionsUsed"] == ["KHR_gaussian_splatting"]
    # Not required: who does not know it shows points.
    assert "extensionsRequired" not in described
    (primitive,) = described["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert extension["kernel"] == "ellipse"
    assert extension["colorSpace"] == "srgb_rec709_display"
    rotation = found["KHR_gaussian_splatting:ROTATION"]
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, rtol=1e-6)
    assert (found["KHR_gaussian_splatting:SCALE"] >= 0).all()
    opacity = found["KHR_gaussian_splatting:OPACITY"]
    assert ((opacity >= 0) & (opacity <= 1)).all()


def test_trimesh_sees_the_gltf_as_points(tmp_path):
    gaussians = _gaussians()
    write_gltf(tmp_path / "a.glb", gaussians)
    (cloud,) = trimesh.load_scene(tmp_path / "a.glb").geometry.values()
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_allclose(cloud.vertices, gaussians.means[0].numpy(), rtol=1e-6)


@pytest.mark.parametrize("format", _COMPRESSED)
def test_compressed_files_show_the_same_head(format, tmp_path):
    gaussforge = pytest.importorskip("gaussforge")
    gaussians = _gaussians()
    camera, white = front_camera(avatar_of(), 96, 96), torch.ones(3)
    write_ply(tmp_path / "plain.ply", gaussians)
    GAUSSIAN_FILES[format].write(tmp_path / "a", gaussians)
    packed = (tmp_path / "a").read_bytes()
    assert len(packed) < (tmp_path / "plain.ply").stat().st_size / 4
    known_as = {"compressed-ply": "compressed.ply"}.get(format, format)
    unpacked = gaussforge.GaussForge().convert(packed, known_as, "ply")
    (tmp_path / "back.ply").write_bytes(unpacked["data"])
    ours = rasterize(gaussians, camera, white).image[0].numpy()
    theirs = rasterize(read_ply(tmp_path / "back.ply"), camera, white).image[0].numpy()
    assert ours.std() > 0.1
    assert psnr(ours, theirs) > 40


def test_spz_has_the_heads_own_axes(tmp_path):
    """By the text of Niantic's format: y up, in fixed point of 24 bits; opacity in 8."""
    pytest.importorskip("gaussforge")
    gaussians = _gaussians()
    GAUSSIAN_FILES["spz"].write(tmp_path / "a.spz", gaussians)
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    magic, version, count, degree, bits = struct.unpack("<4sIIBB", content[:14])
    assert (magic, version, count, degree) == (b"NGSP", 3, gaussians.means.shape[1], 0)
    low, middle, high = np.frombuffer(content[16:], np.uint8, 9 * count).reshape(-1, 3, 3).T
    fixed = low + 256 * middle.astype(np.int32) + 65536 * high.astype(np.int8).astype(np.int32)
    np.testing.assert_allclose(fixed.T / 2**bits, gaussians.means[0], atol=0.51 / 2**bits)
    opacity = np.frombuffer(content[16 + 9 * count :], np.uint8, count) / 255
    np.testing.assert_allclose(opacity, gaussians.opacities[0], atol=0.51 / 255)


def test_without_gaussforge_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    with pytest.raises(UserError, match="pip install"):
        GAUSSIAN_FILES["spz"].write(tmp_path / "a.spz", _gaussians())
    assert not list(tmp_path.iterdir())


def test_what_gaussforge_refuses_is_told(tmp_path, monkeypatch):
    pytest.importorskip("gaussforge")

    class Refuses:
        def convert(self, *_: object) -> dict[str, str]:
            return {"error": "no such thing"}

    monkeypatch.setattr(importlib.import_module("gaussforge"), "GaussForge", Refuses)
    with pytest.raises(UserError, match="no such thing"):
        GAUSSIAN_FILES["sog"].write(tmp_path / "a.sog", _gaussians())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("format", GAUSSIAN_FILES)
def test_several_sets_and_unwritable_places_are_refused(format, tmp_path):
    if format in _COMPRESSED:
        pytest.importorskip("gaussforge")
    avatar = avatar_of()
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="Cannot write"):
        write_gaussians(avatar, lively_theta(avatar, 1), tmp_path / "file" / "a", format)
    with torch.no_grad():
        several = avatar.gaussians(lively_theta(avatar, 2))
    with pytest.raises(ValueError, match="one set"):
        GAUSSIAN_FILES[format].write(tmp_path / "a", several)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("format", ["ply", "gltf"])
def test_a_sequence_is_a_file_a_frame_as_if_written_alone(format, tmp_path):
    avatar = avatar_of()
    theta = lively_theta(avatar, 5)
    write_gaussian_sequence(avatar, theta, (1, 3), tmp_path / "film", format)
    suffix = GAUSSIAN_FILES[format].suffix
    names = sorted(path.name for path in (tmp_path / "film").iterdir())
    assert names == [f"00001{suffix}", f"00003{suffix}"]
    write_gaussians(avatar, theta[3:4], tmp_path / "alone", format)
    assert (tmp_path / "alone").read_bytes() == (Path(tmp_path) / "film" / names[1]).read_bytes()


def test_a_shorter_sequence_leaves_nothing_of_a_longer_one_before_it(tmp_path):
    avatar = avatar_of()
    theta = lively_theta(avatar, 5)
    write_gaussian_sequence(avatar, theta, (0, 1, 2, 4), tmp_path, "ply")
    others = ["00004.glb", "00004.compressed.ply", "000004.ply", "notes.ply"]
    for name in others:
        (tmp_path / name).write_text("")
    write_gaussian_sequence(avatar, theta, (1, 2), tmp_path, "ply")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(["00001.ply", "00002.ply", *others])
