"""Draw by a wheel's compiled rasterizer, with NumPy alone: `python scripts/try_wheel.py WHEEL`.

Every instruction set of this processor draws one Gaussian whose picture is known and a hundred
that all sets must draw alike. torch is not needed, so that a wheel is tried where none is.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

WIDTH, HEIGHT, FOCAL_PX = 64, 48, 60.0


def load_native(wheel: Path, folder: Path) -> ModuleType:
    """The compiled module out of the wheel, imported from `folder`; exits where it holds none."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            names = [n for n in archive.namelist() if "/_native." in n and ".so" in n]
            path = archive.extract(names[0], folder)
    except (OSError, zipfile.BadZipFile, IndexError) as error:
        sys.exit(
            f"{wheel} is no wheel with a compiled rasterizer ({error}): name one that "
            "scripts/build_wheels.py made."
        )
    spec = importlib.util.spec_from_file_location("_native", path)
    assert spec is not None
    assert spec.loader is not None
    native = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(native)
    return native


def draw(native: ModuleType, instruction_set: str, means: Any, scale_m: float, threads: int) -> Any:
    """Image and alpha side by side, [H, W, 4]; colours are the places, opacity is .5.

    means: [N, 3] before a camera at the origin that looks along +z, metres.
    """
    count = len(means)
    gaussians = native.Gaussians(
        np.array(means, np.float32)[None],
        np.array([[[1, 0, 0, 0]]], np.float32).repeat(count, 1),
        np.full((1, count, 3), scale_m, np.float32),
        np.full((1, count), 0.5, np.float32),
        np.array(np.abs(means) % 1, np.float32)[None],
    )
    camera = np.eye(4, dtype=np.float32)[None]
    focal_px = np.full((1, 2), FOCAL_PX, np.float32)
    centre_px = np.array([[WIDTH / 2, HEIGHT / 2]], np.float32)
    session = native.Session(
        gaussians, camera, focal_px, centre_px, 1, WIDTH, HEIGHT, threads, instruction_set
    )
    image = np.zeros((1, HEIGHT, WIDTH, 3), np.float32)
    alpha = np.zeros((1, HEIGHT, WIDTH, 1), np.float32)
    session.draw(np.zeros((1, 3), np.float32), 0, image, alpha, None)
    return np.concatenate((image, alpha), -1)[0]


def main() -> None:
    """Try the wheel named on the command line; ends with an assertion where it draws wrongly."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("wheel", type=Path)
    wheel: Path = parser.parse_args().wheel
    many = np.random.default_rng(1).uniform((-1, -1, 2), (1, 1, 4), (100, 3))
    with tempfile.TemporaryDirectory() as folder:
        native = load_native(wheel, Path(folder))
        known = {
            name: draw(native, name, many, 0.05, threads=2) for name in native.instruction_sets()
        }
        for name, picture in known.items():
            # A wide Gaussian before the camera: at its middle alpha is its opacity, farther off
            # it falls by exp(-d^2 / 2 sigma^2). The rasterizer adds .3 px^2 to sigma^2.
            alone = draw(native, name, np.array([[0, 0, 2]]), 0.25, threads=1)[..., 3]
            sigma_squared = (0.25 / 2 * FOCAL_PX) ** 2 + 0.3
            assert abs(alone[HEIGHT // 2, WIDTH // 2] - 0.5 * np.exp(-0.25 / sigma_squared)) < 1e-4
            far = alone[HEIGHT // 2, WIDTH // 2 + 8]
            assert abs(far - 0.5 * np.exp(-(8.5**2 + 0.5**2) / 2 / sigma_squared)) < 1e-4
            assert picture[..., 3].max() > 0.5, "Gaussians lie over one another"
            assert np.abs(picture - known["generic"]).max() < 1e-4, name
    print(f"{wheel.name}: {', '.join(known)} draw alike on Python {sys.version.split()[0]}")


if __name__ == "__main__":
    main()
