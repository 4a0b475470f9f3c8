import os
import stat
from pathlib import Path

import pytest

from rgbavatar_ns.kernels.cuda.code_cache import cached


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("RGBAVATAR_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def never() -> bytes:
    pytest.fail("made again")


@pytest.mark.parametrize("damage", [b"", b"short", b"x" * 32, None])
def test_a_file_that_is_not_whole_is_made_again_and_replaced(
    folder: Path, damage: bytes | None
) -> None:
    assert cached("code", lambda: b"machine code") == b"machine code"
    stored = (folder / "code").read_bytes()
    if damage is None:
        damage = stored[:-1] + bytes([stored[-1] ^ 1])
    (folder / "code").write_bytes(damage)
    assert cached("code", lambda: b"machine code") == b"machine code"
    assert (folder / "code").read_bytes() == stored
    assert cached("code", never) == b"machine code"


def test_others_may_read_it_as_the_umask_says(folder: Path) -> None:
    before = os.umask(0o027)
    try:
        cached("code", lambda: b"machine code")
    finally:
        os.umask(before)
    assert stat.S_IMODE((folder / "code").stat().st_mode) == 0o640
    assert [path.name for path in folder.iterdir()] == ["code"]


def test_one_that_cannot_be_read_is_done_without(folder: Path) -> None:
    (folder / "code").mkdir(parents=True)
    assert cached("code", lambda: b"machine code") == b"machine code"
    assert [path.name for path in folder.iterdir()] == ["code"]
