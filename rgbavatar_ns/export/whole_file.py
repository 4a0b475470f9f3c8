"""Files that appear under their name only when they are complete."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rgbavatar_ns.errors import UserError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give the path to write to, beside `path` and of its kind; it is renamed at the end.

    Nothing is left where writing fails. Raises UserError where the disk refuses it.
    """
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise UserError(
            f"Cannot write {path}: {error.strerror}.", "Free some space or name another place."
        ) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
