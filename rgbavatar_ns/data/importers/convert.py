"""From a source's records to a folder in the project's own format, on all cores, resumable."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, replace
from pathlib import Path

from rgbavatar_ns.data.importers.flashavatar import tracker_folder
from rgbavatar_ns.data.importers.folder import Folder
from rgbavatar_ns.data.importers.formats import find_format, read_source
from rgbavatar_ns.data.importers.frame_images import make_png
from rgbavatar_ns.data.importers.import_report import ImportReport, UnusableFrameError
from rgbavatar_ns.data.importers.options import ImportOptions, Progress
from rgbavatar_ns.data.importers.source import Source
from rgbavatar_ns.data.importers.transforms import folders_outside
from rgbavatar_ns.data.native.dataset import TrackedDataset, load_native
from rgbavatar_ns.data.native.format import INDEX_FILE
from rgbavatar_ns.data.native.writer import DatasetWriter, give_up
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import digest, read_json, write_json
from rgbavatar_ns.head.flame import COMPANIONS, FLAME_VARIABLE, places_beside

CACHE_FOLDER = ".rgbavatar"
"""In the source; nothing in it belongs to the source."""
_STATE_FILE = ".import.json"
_IMPORTER_VERSION, _VERSIONS = 3, {"imavatar": 4}
"""To be raised where the same files give another dataset, in one format or in all."""


def import_dataset(
    src: str | Path,
    dst: str | Path,
    options: ImportOptions | None = None,
    *,
    overwrite: bool = False,
    link: bool = False,
    progress: Progress | None = None,
) -> TrackedDataset:
    """Write a folder of another system to `dst` in the project's own format.

    An interrupted import goes on where it was; a finished one is opened, or with `overwrite` made
    anew, damaged or not. `link` shares the bytes of images that need no change. Raises UserError
    where something cannot be used, or `dst` holds something else and `overwrite` is not given.
    """
    src, dst, options = Path(src), Path(dst), options or ImportOptions()
    key = fingerprint(src, options, dst)
    state, finished = read_json(dst / _STATE_FILE), (dst / INDEX_FILE).exists()
    same = isinstance(state, dict) and state.get("key") == key
    if same and finished and not overwrite:
        return _opened(dst)
    if src.resolve() == dst.resolve():
        raise UserError(f"{dst} is the data itself.", "Name another folder to write to.")
    source = read_source(src, options, progress)
    if finished and overwrite and (dst / _STATE_FILE).exists():
        # An import of ours; its index may be damaged, and then tells nobody what it is.
        give_up(dst)
    writer = DatasetWriter(
        dst,
        source.arrays,
        source.identity,
        source.layout,
        source.cameras.width,
        source.cameras.height,
        overwrite=overwrite or (isinstance(state, dict) and not finished),
        keep_images=same and not finished,
        source={
            "format": source.format,
            "path": str(src.resolve()),
            "notes": list(source.notes),
            "options": {name: str(value) for name, value in asdict(options).items() if value},
        },
    )
    write_json(dst / _STATE_FILE, {"key": key, "source": str(src.resolve())})
    unusable = _write_images(source, writer, link, progress)
    report = ImportReport()
    for position, reason in sorted(unusable.items()):
        report.leave_out(reason, [source.frame_images[position].color.name])
    report.settle(f"The {source.format} data in {source.root}", options.allow_partial)
    if len(unusable) == len(source):
        raise UserError(f"No image of {source.root} can be used.", "Look at its files.")
    for position, index in enumerate(source.index):
        if position not in unusable:
            writer.add_encoded(
                index,
                source.theta[position],
                source.cameras.select([position]),
                None,
                source.camera_names[position],
                source.timesteps[position],
            )
    return writer.finish(source.test - {source.index[position] for position in unusable})


def _opened(dst: Path) -> TrackedDataset:
    """A finished import; raises UserError where it is damaged."""
    try:
        return load_native(dst)
    except UserError as error:
        raise UserError(error.cause, "Import the data anew with --overwrite.") from None


def _write_images(
    source: Source, writer: DatasetWriter, link: bool, progress: Progress | None
) -> dict[int, str]:
    """Put every image into its place; positions of those that cannot be used, and why."""
    unusable: dict[int, str] = {}
    # OpenCV and zlib let other threads run while they work.
    pool = ThreadPoolExecutor(os.cpu_count() or 1, "import")
    try:
        jobs = {
            pool.submit(_write_image, source, writer, position, link): position
            for position in range(len(source))
        }
        for done, job in enumerate(as_completed(jobs), 1):
            try:
                job.result()
            except UnusableFrameError as error:
                unusable[jobs[job]] = str(error)
            if progress is not None:
                progress("converting images", done, len(jobs))
    finally:
        pool.shutdown(cancel_futures=True)
    return unusable


def _write_image(source: Source, writer: DatasetWriter, position: int, link: bool) -> None:
    frame_image, index = source.frame_images[position], source.index[position]
    place = writer.image_path(index)
    if place.exists():
        return
    png = make_png(frame_image, (source.cameras.width, source.cameras.height))
    if link and png.is_original:
        try:
            os.link(frame_image.color.resolve(), place)
        except OSError:  # another disk, or one without links
            pass
        else:
            return
    writer.write_image(index, png.encoded)


def fingerprint(src: Path, options: ImportOptions, dst: Path | None = None) -> str:
    """What an import depends on, hashed: see `source_fingerprint` and `flame_fingerprint`."""
    return f"{source_fingerprint(src, options, dst)}-{flame_fingerprint(options) or 'none'}"


def source_fingerprint(src: Path, options: ImportOptions, dst: Path | None = None) -> str:
    """Names, sizes and times of all files of the data, and all options but FLAME's place.

    dst: where the import goes, which counts for nothing, be it in the data.
    """
    others = replace(options, flame=None, flame_uv=None, flame_eyelids=None)
    found = find_format(src, options) if src.is_dir() else None
    version = _VERSIONS.get(found.key if found else "", _IMPORTER_VERSION)
    places = source_places(src, options)
    lines = _listing(places, follow_out=options.allow_outside, without=dst)
    return digest([f"{version} {others}", *lines])[:16]


def source_places(src: Path, options: ImportOptions) -> list[str | Path]:
    """Where the data lies: its folder, and what its format or the options take from outside."""
    found = find_format(src, options) if src.is_dir() else None
    outside: list[Path] = []
    if found and found.key == "flashavatar":
        outside = [tracker_folder(Folder(src))]
    elif found and options.allow_outside:
        outside = folders_outside(Folder(src))
    places = [src, *outside, options.images, options.masks]
    return [place for place in places if place is not None]


def flame_fingerprint(options: ImportOptions) -> str | None:
    """Names, sizes and times of FLAME's files; None where no FLAME is named.

    Those count too that lie beside the pickle, or would be taken if they did.
    """
    flame = options.flame or os.environ.get(FLAME_VARIABLE)
    if not flame:
        return None
    # A folder is listed with all that is in it, but its pickle takes from the one above too.
    places = places_beside(Path(flame).expanduser())
    beside = [place / name for place in places for name in COMPANIONS]
    named = [flame, options.flame_uv, options.flame_eyelids, *beside]
    return digest(_listing(named, follow_out=True))[:8]


def _listing(
    places: Sequence[str | Path | None], *, follow_out: bool, without: Path | None = None
) -> Iterator[str]:
    """A line for each file below the places.

    Links to folders that lead out of a place count by what they hold only with `follow_out`: what
    is not read must not be walked either, which may be the whole disk.
    """
    for place in places:
        if place is not None:
            yield from _lines(place, follow_out, without and Path(os.path.realpath(without)))


def _lines(place: str | Path, follow_out: bool, without: Path | None) -> Iterator[str]:
    top = os.path.realpath(os.path.expanduser(place))
    if os.path.isfile(top):
        yield _line(os.path.dirname(top), os.path.basename(top))
    for folder, names, out in data_folders(top, follow_out=follow_out, without=without):
        # A folder that only leads to an import was made by it.
        if names or without is None or not without.is_relative_to(os.path.realpath(folder)):
            yield f"{os.path.relpath(folder, top)}\n"
        yield from (f"{name} -> {os.readlink(os.path.join(folder, name))}\n" for name in out)
        for name in names:
            yield _line(folder, name)


def data_folders(
    top: str, *, follow_out: bool = False, without: Path | None = None
) -> Iterator[tuple[str, list[str], list[str]]]:
    """A folder and all below it that hold data, links followed once: each with its files' names.

    The last are the names of links that lead out of the top and are not followed. `without` is a
    real path that is left out.
    """
    seen: set[str] = set()
    for folder, names, files in os.walk(top, followlinks=True):
        real = os.path.realpath(folder)
        names[:] = sorted(name for name in names if _is_data(name))
        if real in seen:
            names.clear()
            continue
        seen.add(real)
        places = {name: os.path.realpath(os.path.join(folder, name)) for name in names}
        names[:] = [name for name in names if places[name] != str(without)]
        out = [name for name in names if not Path(places[name]).is_relative_to(top)]
        out = [] if follow_out else out
        names[:] = [name for name in names if name not in out]
        yield folder, sorted(filter(_is_data, files)), out


def _is_data(name: str) -> bool:
    """Not hidden, as our own imports are, and not where ns-train writes by default."""
    return not name.startswith(".") and name != "outputs"


def _line(folder: str, name: str) -> str:
    try:
        facts = os.stat(os.path.join(folder, name))
    except OSError:
        return f"{name} missing\n"
    return f"{name} {facts.st_size} {facts.st_mtime_ns}\n"
