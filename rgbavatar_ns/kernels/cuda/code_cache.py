"""Compiled kernels on the disk, for the next start."""

import contextlib
import hashlib
import os
import uuid
from collections.abc import Callable
from pathlib import Path

_DIGEST_BYTES = 32


def cache_folder() -> Path:
    """Where compiled kernels are kept: RGBAVATAR_CACHE, or the user's cache folder."""
    if "RGBAVATAR_CACHE" in os.environ:
        return Path(os.environ["RGBAVATAR_CACHE"])
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "rgbavatar_ns"


def cached(name: str, make: Callable[[], bytes]) -> bytes:
    """What lies in the cache by this name; else it is made and put there.

    A file that is not whole, as a machine that stopped may leave it, is replaced. A cache that
    cannot be read or written costs what making costs at each start, nothing else.
    """
    path = cache_folder() / name
    with contextlib.suppress(OSError):
        digest, content = _split(path.read_bytes())
        if hashlib.sha256(content).digest() == digest:
            return content
    content = make()
    with contextlib.suppress(OSError):
        _write_whole(path, hashlib.sha256(content).digest() + content)
    return content


def _split(stored: bytes) -> tuple[bytes, bytes]:
    return stored[:_DIGEST_BYTES], stored[_DIGEST_BYTES:]


def _write_whole(path: Path, content: bytes) -> None:
    """Other processes see nothing or all of it, and whoever the umask lets may read it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{uuid.uuid4().hex}.partial")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
