"""Every importer's folder: any file damaged, any value of an index absurd; told, or the same."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch

from rgbavatar_ns.data.importers import ImportOptions, Source, flame_parameters, read_source
from rgbavatar_ns.data.importers.frame_images import make_png
from rgbavatar_ns.data.importers.import_report import UnusableFrameError
from rgbavatar_ns.data.importers.mesh_fit import read_mesh
from rgbavatar_ns.data.png import decode_png_rgba
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.flame import FLAME_VERTICES
from rgbavatar_ns.synthetic.exporters import Take
from rgbavatar_ns.synthetic.exporters.folders import (
    FlashAvatarWriter,
    IMAvatarWriter,
    InstaWriter,
    MetricalWriter,
    VhapWriter,
)
from tests.data.importers.takes import HEIGHT, WIDTH, make_frame
from tests.fuzz.attacks import Case, copied, harm, harm_json
from tests.head.synthetic_head import flame_shaped_arrays

NAME = "importers"
NUM_FRAMES = 3
_WRITERS = {
    "insta": InstaWriter,
    "metrical": MetricalWriter,
    "vhap": VhapWriter,
    "imavatar": IMAvatarWriter,
    "flashavatar": FlashAvatarWriter,
}
_CHECKED = (".png", ".npz", ".frame")
"""These have checksums of all that they hold."""


@cache
def _small_flame(version: str) -> HeadArrays:
    """Of 36 vertices, for speed."""
    return replace(flame_shaped_arrays(), name=f"FLAME {version}")


@contextmanager
def _known_flame() -> Iterator[None]:
    read = flame_parameters.load_flame
    flame_parameters.load_flame = lambda path=None, **options: _small_flame(Path(path).name)
    try:
        yield
    finally:
        flame_parameters.load_flame = read


def write(root: Path) -> dict[str, tuple[Path, str]]:
    """A small folder of every format by its key, and FLAME's version."""
    made = {}
    for key, writer in _WRITERS.items():
        version = "2023" if key == "vhap" else "2020"
        generator = np.random.default_rng(0)
        take = Take(_small_flame(version), np.zeros(300), NUM_FRAMES, 1, WIDTH, HEIGHT, "data")
        writing = writer(root / key, take)
        for index in range(NUM_FRAMES):
            writing.add(make_frame(index, generator, stiff_neck=key != "vhap"))
        writing.finish()
        made[key] = (root / key, version)
    columns: dict[str, list[np.ndarray]] = {}
    for path in sorted((root / "vhap/flame_param").iterdir()):
        with np.load(path) as file:
            values = {name: file[name] for name in file.files if name != "static_offset"}
        np.savez(path, **values)
        for name, value in values.items():
            columns.setdefault(name, []).append(value)
    raw = root / "vhap-raw"
    for kind in ("images", "fg_masks"):
        shutil.copytree(root / "vhap" / kind, raw / kind)
    names = np.array([path.stem for path in sorted((raw / "images").iterdir())])
    stacked = {
        name: column[0] if name == "shape" else np.concatenate(column)
        for name, column in columns.items()
    }
    stacked |= {"timestep_id": names, "focal_length": np.array([1.5])}
    np.savez(raw / "tracked_flame_params_30.npz", **stacked)
    made["vhap-raw"] = (raw, "2023")
    for key in ("rgbavatar", "gaussianblendshapes", "nerfblendshape"):
        for part in ("checkpoint", "images"):
            shutil.copytree(root / "insta" / part, root / key / part)
        made[key] = (root / key, "2020")
    (root / "gaussianblendshapes/canonical.obj").write_text("v 0 0 0\n")
    shutil.copytree(root / "metrical/alpha", root / "nerfblendshape/image_mask")
    return made


def cases(seed: int, count: int) -> Iterator[Case]:
    """One file harmed, or a value of an index; and meshes."""
    generator = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name, _known_flame():
        folders = write(Path(name))
        wholes = {key: _read(*folders[key], True) for key in folders}
        for _ in range(count):
            child = np.random.default_rng(int(generator.integers(2**60)))
            if generator.integers(20) == 0:
                yield "mesh", partial(_mesh, Path(name) / "mesh.obj", child)
                continue
            key = sorted(folders)[int(generator.integers(len(folders)))]
            folder, version = folders[key]
            files = sorted(path for path in folder.rglob("*") if path.is_file())
            indices = [path for path in files if path.suffix == ".json"]
            chosen = indices if indices and generator.integers(2) else files
            file = chosen[int(generator.integers(len(chosen)))].relative_to(folder)
            told = f"{key} {file}"
            yield told, partial(_attack, folder, version, file, wholes[key], child)


_Read = tuple[Source, dict[int, np.ndarray | None]]
"""And each frame's picture by number; None where it was told that it cannot be used."""


def _read(folder: Path, version: str, partly: bool) -> _Read:
    options = ImportOptions(
        flame=Path(version), teeth=False, allow_partial=partly, head_pose="source", test_frames=0
    )
    source = read_source(folder, options)
    images: dict[int, np.ndarray | None] = {}
    for number, frame_image in zip(source.index, source.frame_images):
        try:
            png = make_png(frame_image, (source.cameras.width, source.cameras.height))
            images[number] = decode_png_rgba(png.encoded, "")
        except UnusableFrameError as error:
            if not partly:
                raise UserError(str(error), "Mend it.") from None
            images[number] = None
    return source, images


def _attack(
    folder: Path, version: str, file: Path, whole: _Read, generator: np.random.Generator
) -> None:
    with copied(folder) as copy:
        of_json = file.suffix == ".json" and bool(generator.integers(8))
        is_checked = file.suffix in _CHECKED
        if of_json:
            harm_json(copy / file, generator)
        else:
            harm(copy / file, generator, is_checked)
        source, images = _read(copy, version, bool(generator.integers(2)))
    _require_sane(source)
    if len(source) < NUM_FRAMES:
        assert any("left out" in note for note in source.notes), "frames are gone in silence"
    if is_checked:
        _require_same(source, images, *whole)


def _require_sane(source: Source) -> None:
    assert source.layout.absurd(source.theta) is None
    cameras = source.cameras
    for part in (cameras.world_to_camera, cameras.focal_px, cameras.principal_point_px):
        assert part.isfinite().all()
    assert source.identity.isfinite().all()


def _require_same(source: Source, images, whole: Source, pictures) -> None:
    assert torch.equal(source.identity, whole.identity), "another head shape"
    for position, number in enumerate(source.index):
        place = whole.index.index(number)
        assert torch.equal(source.theta[position], whole.theta[place]), "another theta"
        for part in ("world_to_camera", "focal_px", "principal_point_px"):
            mine, theirs = getattr(source.cameras, part), getattr(whole.cameras, part)
            assert torch.equal(mine[position], theirs[place]), f"another {part}"
        image = images[number]
        assert image is None or np.array_equal(image, pictures[number]), "another picture"


def _mesh(path: Path, generator: np.random.Generator) -> None:
    rows = generator.normal(size=(FLAME_VERTICES, 3)).round(3).tolist()
    lines = [f"v {x} {y} {z}" for x, y, z in rows]
    wrong = (
        "v 1 2",
        "v nan 0 0",
        "v " + "1 " * 100_000,
        "v 1e999 0 0",
        "v a b c",
        "\0",
        "v 1 2 3 4",
    )
    lines[int(generator.integers(len(lines)))] = wrong[int(generator.integers(len(wrong)))]
    if path.is_dir():
        path.rmdir()
    path.unlink(missing_ok=True)
    path.write_text("\n".join(lines))
    if generator.integers(2):
        harm(path, generator)
    try:
        vertices = read_mesh(path)
    except UnusableFrameError:
        return
    assert vertices.shape == (FLAME_VERTICES, 3)
    assert vertices.isfinite().all()
