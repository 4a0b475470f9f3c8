"""Folders of other systems, imported once behind the scenes and then opened as our own."""

import glob
import os
import shutil
import sys
from pathlib import Path

from rgbavatar_ns.data.importers.convert import (
    CACHE_FOLDER,
    fingerprint,
    flame_fingerprint,
    import_dataset,
    source_fingerprint,
)
from rgbavatar_ns.data.importers.formats import find_format
from rgbavatar_ns.data.importers.options import ImportOptions, Progress
from rgbavatar_ns.data.native.dataset import TrackedDataset, load_native
from rgbavatar_ns.data.native.format import INDEX_FILE
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import DiskError, hold_lock

_NO_BACKUP = "Signature: 8a477f597d28d172789f06886806bc55\n# Made by rgbavatar; may be deleted.\n"


def open_foreign(
    src: Path, options: ImportOptions, progress: Progress | None = None
) -> TrackedDataset:
    """Open a folder of another system through its import, made now if need be.

    The import lies in the folder itself (`.rgbavatar/`) where that may be written to, else in the
    user's cache directory; its name is a hash of the files and options that it depends on. A
    damaged one is made anew.
    """
    name = fingerprint(src, options)
    places = _places(src, name)
    if flame_fingerprint(options) is None:
        # Once imported, FLAME itself is not needed: any import of the same data will do.
        made = [
            place
            for pattern in _places(src, f"{source_fingerprint(src, options)}-*")
            for place in pattern.parent.glob(pattern.name)
        ]
    else:
        made = places
    for place in made:
        opened = _opened(place)
        if opened is not None:
            return opened
    place = next((place for place in places if _can_be_made(place)), None)
    if place is None:
        raise UserError(
            f"The import of {src} can be written neither to {places[0]} nor to {places[1]}.",
            "Free some space or name a folder: rgbavatar import SRC DST.",
        )
    found = find_format(src, options)
    # Two programs that open the same data import it one after the other.
    with hold_lock(place.with_name(f"{place.name}.lock")):
        opened = _opened(place)
        if opened is not None:
            return opened
        damaged = (place / INDEX_FILE).exists()
        dataset = _imported(src, place, options, damaged, progress)
    recognised = "" if found is None else f"{found.name} data in "
    how = "its import was damaged, made anew" if damaged else "imported once"
    print(f"{recognised}{src}: {how} into {place}", file=sys.stderr)
    return dataset


def _imported(
    src: Path, place: Path, options: ImportOptions, overwrite: bool, progress: Progress | None
) -> TrackedDataset:
    """The import made; of data that cannot be used nothing stays there."""
    try:
        return import_dataset(
            src, place, options, overwrite=overwrite, link=True, progress=progress
        )
    except DiskError:
        raise  # With some space it goes on from what is there.
    except UserError:
        shutil.rmtree(place, ignore_errors=True)
        raise


def _opened(place: Path) -> TrackedDataset | None:
    """The import that lies there; None where there is none, or a damaged one."""
    if not (place / INDEX_FILE).exists():
        return None
    try:
        return load_native(place)
    except UserError:
        return None


def _places(src: Path, name: str) -> list[Path]:
    """Where an import of this name may lie: in the data, or in the user's cache."""
    subject = glob.escape(src.resolve().name) if name.endswith("*") else src.resolve().name
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return [src / CACHE_FOLDER / name, user / "rgbavatar" / "imports" / f"{subject}-{name}"]


def _can_be_made(place: Path) -> bool:
    try:
        place.mkdir(parents=True, exist_ok=True)
        # Backup programs pass over a folder with such a file.
        (place.parent / "CACHEDIR.TAG").write_text(_NO_BACKUP)
    except OSError:
        return False
    return os.access(place, os.W_OK)
