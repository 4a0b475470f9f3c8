"""The project's own dataset folder: any file damaged, any value of its index absurd."""

import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch

from rgbavatar_ns.data import DatasetWriter, TrackedFrame
from rgbavatar_ns.data.native.dataset import TrackedDataset, load_native
from rgbavatar_ns.head import HeadModel
from tests.data.small_dataset import CAMERA_PARTS, HEIGHT, WIDTH, noise_image, odd_camera
from tests.fuzz.attacks import Case, copied, harm, harm_json
from tests.head.synthetic_head import flame_shaped_arrays

NAME = "native"
NUM_FRAMES = 3


def write(folder: Path) -> TrackedDataset:
    """Three small frames of two cameras."""
    head = HeadModel(flame_shaped_arrays())
    identity = torch.linspace(-1, 1, head.num_identity) / 3
    writer = DatasetWriter(folder, head.arrays, identity, head.layout, WIDTH, HEIGHT)
    for index in range(NUM_FRAMES):
        theta = torch.randn(head.layout.size, generator=torch.Generator().manual_seed(index))
        camera, name = odd_camera((index % 2) / 17), f"camera {index % 2}"
        writer.add(TrackedFrame(index, theta, camera, noise_image(index), name, index))
    return writer.finish({1})


def cases(seed: int, count: int) -> Iterator[Case]:
    """One file harmed, or values of the index."""
    generator = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "data"
        whole = write(folder)
        files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
        for _ in range(count):
            child = np.random.default_rng(int(generator.integers(2**60)))
            if generator.integers(2):
                yield "index", partial(_index, folder, child)
            else:
                file = files[int(generator.integers(len(files)))]
                yield file.name, partial(_file, folder, file, whole, child)


def _index(folder: Path, generator: np.random.Generator) -> None:
    with copied(folder) as copy:
        for _ in range(int(generator.integers(1, 3))):
            told = harm_json(copy / "dataset.json", generator)
            if not (copy / "dataset.json").read_bytes().isascii() or "'" in told:
                break
        _require_sane(load_native(copy))


def _file(folder: Path, file: Path, whole: TrackedDataset, generator: np.random.Generator) -> None:
    with copied(folder) as copy:
        # Neither an npy nor a text has a checksum.
        is_checked = file.suffix in (".png", ".npz")
        harm(copy / file, generator, is_checked)
        read = load_native(copy)
        _require_sane(read)
        images = [read.read_image(position) for position in range(len(read))]
        if not is_checked:
            return
        assert torch.equal(read.theta, whole.theta)
        assert read.arrays.digest() == whole.arrays.digest(), "another head"
        for position, image in enumerate(images):
            assert np.array_equal(image, noise_image(position)), "another picture"


def _require_sane(read: TrackedDataset) -> None:
    assert read.layout.absurd(read.theta) is None
    assert read.identity.isfinite().all()
    for part in CAMERA_PARTS:
        assert getattr(read.cameras, part).isfinite().all()
    for number in (read.width, read.height, *read.frame_index, *read.timesteps):
        assert type(number) is int
        assert 0 <= number <= 10**15
    assert set(read.train) | set(read.test) == set(range(len(read)))
