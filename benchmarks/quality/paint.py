"""How sharply paint shows on an avatar, and what a compressed file of it costs.

    python benchmarks/quality/paint.py RUN

RUN: a run of ns-train, a checkpoint or a bundle. Checks are painted over the middle of its texture
and put back; PSNR over the checks of the painted avatar's own texture to what was painted. Each
file of Gaussians is read back by GaussForge and drawn from the front, 512 x 512, on white; PSNR to
the avatar's picture.
"""

import argparse
import tempfile
from pathlib import Path

import gaussforge
import numpy as np
import torch
from plyfile import PlyData

from rgbavatar_ns import Avatar
from rgbavatar_ns.export import (
    GAUSSIAN_FILES,
    color_texture,
    front_camera,
    with_texture,
    write_gaussians,
)
from rgbavatar_ns.export.texture import PIXELS_PER_TEXEL
from rgbavatar_ns.kernels import GaussianSet, rasterize

_CHECK_TEXELS = (2, 4, 8)
_COLORS = ((10, 60, 240), (250, 160, 20))
_MIDDLE = 0.12, 0.55, 0.3, 0.72
"""Of the texture: first and last row, first and last column; the face is there."""
_SIDE_PX = 512


def psnr(difference: np.ndarray) -> float:
    """Of a difference of pictures in [0, 1], in dB."""
    return float(-10 * np.log10((difference.astype(np.float64) ** 2).mean()))


def painted(avatar: Avatar, check_texels: int) -> tuple[float, float]:
    """PSNR of checks to the avatar's texture before and after painting them."""
    own = color_texture(avatar)
    number = np.arange(len(own)) // (check_texels * PIXELS_PER_TEXEL)
    checks = np.where((number[:, None] + number)[..., None] % 2, *_COLORS)
    top, bottom, left, right = (round(share * len(own)) for share in _MIDDLE)
    middle = slice(top, bottom), slice(left, right), slice(3)
    picture = own.copy()
    picture[middle] = checks[middle]
    after = color_texture(with_texture(avatar, picture))
    before, after = (
        psnr((shown[middle].astype(float) - checks[middle]) / 255) for shown in (own, after)
    )
    return before, after


def read_ply(path: Path) -> GaussianSet:
    """The Gaussians of a PLY file of 3DGS."""
    vertex = PlyData.read(str(path))["vertex"]

    def columns(stem: str, count: int) -> torch.Tensor:
        found = np.stack([np.asarray(vertex[f"{stem}{i}"]) for i in range(count)], 1)
        return torch.from_numpy(found)[None]

    place = np.stack([np.asarray(vertex[axis]) for axis in "xyz"], 1)
    return GaussianSet(
        means=torch.from_numpy(place)[None],
        quats_wxyz=columns("rot_", 4),
        scales=columns("scale_", 3).exp(),
        opacities=torch.from_numpy(np.asarray(vertex["opacity"]))[None].sigmoid(),
        colors=0.5 + 0.28209479177387814 * columns("f_dc_", 3),
    )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    avatar = Avatar.load(parser.parse_args().run).without_undrawn()
    print(f"{avatar.num_gaussians} Gaussians, {avatar.anchors.resolution} texels a side")
    for check_texels in _CHECK_TEXELS:
        before, after = painted(avatar, check_texels)
        print(f"checks of {check_texels} texels: {before:.1f} dB unpainted, {after:.1f} dB painted")
    camera, white = front_camera(avatar, _SIDE_PX, _SIDE_PX), torch.ones(3)
    rest = torch.zeros(1, avatar.layout.size)
    truth = avatar.render(rest, camera, white).image.numpy()
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.ply"
        for name, file in GAUSSIAN_FILES.items():
            path = Path(folder) / f"avatar{file.suffix}"
            write_gaussians(avatar, rest, path, name)
            told = f"{name}: {path.stat().st_size / 1e3:.0f} kB"
            if name != "gltf":  # which GaussForge does not read; the tests compare its numbers
                known_as = file.suffix.removeprefix(".")
                back = gaussforge.GaussForge().convert(path.read_bytes(), known_as, "ply")
                plain.write_bytes(back["data"])
                image = rasterize(read_ply(plain), camera, white).image.numpy()
                told += f", {psnr(image - truth):.1f} dB"
            print(told)


if __name__ == "__main__":
    main()
