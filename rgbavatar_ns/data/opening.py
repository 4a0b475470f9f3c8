"""The one entrance to datasets: the project's own folders, and those of other systems."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import Progress as Bars
from rich.progress import TaskID

from rgbavatar_ns.data.importers import ImportOptions, find_format, open_foreign
from rgbavatar_ns.data.importers.options import Progress
from rgbavatar_ns.data.native.dataset import TrackedDataset, load_native
from rgbavatar_ns.data.native.format import INDEX_FILE


def load_dataset(
    path: str | Path, options: ImportOptions | None = None, progress: Progress | None = None
) -> TrackedDataset:
    """Read a dataset folder and check all of it but the pixels; raises UserError as `load_native`.

    A folder of another system is imported once, into a cache, and opened from there; `options`
    say how, and `progress` is called with (stage, done, in all) instead of bars being shown.
    """
    root, options = Path(path), options or ImportOptions()
    own = os.path.exists(root / INDEX_FILE) and options.format is None
    if own or not is_dataset(root, options):
        return load_native(root)
    if progress is not None:
        return open_foreign(root, options, progress)
    with _bars() as shown:
        return open_foreign(root, options, shown)


def is_dataset(path: Path, options: ImportOptions | None = None) -> bool:
    """Whether the folder is one of ours or of a known system, damaged or not."""
    if os.path.exists(path / INDEX_FILE):
        return True
    return os.path.isdir(path) and find_format(path, options or ImportOptions()) is not None


@contextmanager
def _bars() -> Iterator[Progress]:
    """A bar for each stage on stderr."""
    tasks: dict[str, TaskID] = {}
    with Bars(console=Console(stderr=True), transient=True) as bars:

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage)
            bars.update(tasks[stage], completed=done, total=total)

        yield show
