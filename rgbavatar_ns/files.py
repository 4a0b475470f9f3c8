"""Files and folders that are whole at every moment, what tells contents apart, and resuming."""

import errno
import glob
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.reading import DamagedFileError, load_json

ROOM_OR_PLACE = "Free some space or name another place."
_SAMPLES, _SAMPLE_BYTES = 5, 1 << 20
_DIGEST_DIGITS = 10


class DiskError(UserError):
    """A place cannot be written; what is there already stays worth going on with."""


@contextmanager
def disk_errors(
    place: Path, remedy: str = ROOM_OR_PLACE, also: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """Raise what the disk refuses (OSError, and a library's own errors, `also`) as DiskError.

    One that was told within, and of which nothing particular is to be done, gets this remedy.
    """
    try:
        yield
    except DiskError as error:
        if error.remedy != ROOM_OR_PLACE:
            raise
        raise DiskError(error.cause, remedy) from error.__cause__
    except (OSError, *also) as error:
        if getattr(error, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
            raise DiskError(f"There is no space left to write {place}.", remedy) from error
        reason = getattr(error, "strerror", None) or error
        if isinstance(error, FileExistsError) and Path(error.filename or ".").is_file():
            reason = f"{error.filename} is a file"  # In the place of a folder.
        raise DiskError(f"Cannot write {place}: {reason}.", remedy) from error


@contextmanager
def atomic_write(
    path: Path,
    *,
    partial: Path | None = None,
    remedy: str = ROOM_OR_PLACE,
    also: tuple[type[Exception], ...] = (),
    sync: bool = True,
) -> Iterator[Path]:
    """Give the path to write to; at the end it gets the name `path`, in place of an older file.

    That path, of the same suffix, lies beside `path`, or is `partial` on the same disk. A reader
    sees the old file or the whole new one, and nothing is left where writing fails. Without `sync`
    a power cut may still leave a short file: for many files that are checked when read. Folders
    are made. Raises DiskError as `disk_errors` does, UserError where `path` has no name.
    """
    _require_name(path)
    partial = partial or path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        with disk_errors(path, remedy, also):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield partial
            if sync:
                _sync(partial)
            os.replace(partial, path)
            if sync:
                _sync_folder(path.parent)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


@contextmanager
def atomic_folder(
    path: Path, *, remedy: str = ROOM_OR_PLACE, also: tuple[type[Exception], ...] = ()
) -> Iterator[Path]:
    """As `atomic_write`, of a folder: give an empty one, which takes the place of an older one.

    Killed in between, the old folder or the new one is whole, beside `path` if not there.
    """
    _require_name(path)
    partial, old = (path.with_name(f".{path.name}.{kind}") for kind in ("partial", "old"))
    try:
        with disk_errors(path, remedy, also):
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            yield partial
            for file in filter(Path.is_file, partial.rglob("*")):
                _sync(file)
            if path.exists():
                shutil.rmtree(old, ignore_errors=True)
                path.rename(old)
            partial.rename(path)
            _sync_folder(path.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if path.exists():
            shutil.rmtree(old, ignore_errors=True)


@contextmanager
def hold_lock(path: Path, waiting: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Hold the lock file `path`, which goes with the process; call `waiting` if another has it."""
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        waiting()
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def keep_numbered(folder: Path, suffix: str, numbers: Container[int]) -> None:
    """Remove files named 00000SUFFIX and so on of other numbers: an earlier sequence's."""
    digits = 5
    for path in folder.glob("[0-9]" * digits + glob.escape(suffix)):
        if int(path.name[:digits]) not in numbers:
            path.unlink()


def _require_name(path: Path) -> None:
    """Raise UserError where a path has no last name that could be written, as `.` and `/`."""
    if path.name in ("", ".."):
        raise UserError(
            f"{path} is a place, but no name of something to write.",
            f"Name what is to be written, such as {path / 'avatar'}.",
        )


def _sync(path: Path) -> None:
    """Have the file's bytes on the disk before it gets its name."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    """Make a rename last through a power cut, where the system lets folders be opened."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """What `write_json` wrote; None where there is no such file or it holds something else."""
    try:
        return load_json(path)
    except DamagedFileError:
        return None


def written_json(path: Path) -> Any:
    """What another step of the same work wrote; raises UserError where it cannot be read."""
    try:
        return load_json(path)
    except DamagedFileError as error:
        raise UserError(f"{path} cannot be read: {error}.", "Run the same command again.") from None


def digest(parts: Iterable[str | bytes | np.ndarray]) -> str:
    """SHA-256 (64 hexadecimal digits) of texts, bytes and arrays, with their types and shapes."""
    whole = hashlib.sha256()
    for part in parts:
        if isinstance(part, str):
            whole.update(part.encode("utf-8", "surrogateescape"))
        elif isinstance(part, bytes):
            whole.update(part)
        else:
            array = np.ascontiguousarray(part)
            whole.update(f"{array.dtype.str}{array.shape}".encode())
            whole.update(array.tobytes())
    return whole.hexdigest()


def digest_of_file(path: Path) -> str:
    """`digest` of a file's size and of samples of its content, so that long videos take no time.

    Raises UserError where it cannot be read.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            parts: list[str | bytes] = [str(size)]
            for sample in range(_SAMPLES):
                file.seek(max(0, size - _SAMPLE_BYTES) * sample // (_SAMPLES - 1))
                parts.append(file.read(_SAMPLE_BYTES))
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}.", "Check the file.") from None
    return digest(parts)


class Stages:
    """Stages of longer work: each is done once, and interrupted work goes on from where it was.

    `folder/stages.json` remembers, by name, each finished stage's result with a key: a hash of
    what it was made from and of what the stages before it were made from. With another key it is
    done again. What JSON cannot hold, a stage writes to files that its result names.

    Args:
        made_from: what all stages depend on, as JSON or anything with a text of its own.
        fresh: forget what was done.
        tell: called with a stage's name as it begins, and the seconds where it was done before.
    """

    def __init__(
        self,
        folder: Path,
        made_from: Any = None,
        *,
        fresh: bool = False,
        tell: Callable[[str, float | None], object] = lambda name, seconds: None,
    ) -> None:
        self.seconds: dict[str, float] = {}
        self._path = folder / "stages.json"
        self._tell = tell
        self._forgets = fresh
        self._key = ""
        if made_from is not None:
            self._key = self._next_key("", made_from)
        known = None if fresh else read_json(self._path)
        self._done: dict[str, dict[str, Any]] = known if isinstance(known, dict) else {}

    def run(self, name: str, made_from: Any, action: Callable[[str], Any]) -> Any:
        """Return the stage's result: remembered, or from `action(key)`, where key names it."""
        self._key = self._next_key(name, made_from)
        known = self._done.get(name)
        if known is not None and known["key"] == self._key:
            self._tell(name, known["seconds"])
        else:
            self._tell(name, None)
            if known is not None or self._forgets:
                # What was done may be replaced now, and is not whole meanwhile.
                self._done.pop(name, None)
                self._forgets = False
                write_json(self._path, self._done)
            started = time.monotonic()
            result = action(self._key)
            seconds = time.monotonic() - started
            known = {"key": self._key, "seconds": seconds, "result": result}
            self._done[name] = known
            write_json(self._path, self._done)
        self.seconds[name] = known["seconds"]
        return known["result"]

    def known(self, name: str) -> Any:
        """The stage's last result, whatever it was made from; None where it was never done."""
        known = self._done.get(name)
        return None if known is None else known["result"]

    def forget_from(self, file_name: str) -> None:
        """The stage whose result names this file, and those done after it, are to be done again."""
        told = json.dumps(file_name)
        done = list(self._done.items())
        for place, (_, known) in enumerate(done):
            if told in json.dumps(known["result"]):
                self._done = dict(done[:place])
                write_json(self._path, self._done)
                return

    def _next_key(self, name: str, made_from: Any) -> str:
        text = json.dumps([self._key, name, made_from], sort_keys=True, default=str)
        return digest([text])[:_DIGEST_DIGITS]
