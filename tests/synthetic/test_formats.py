"""The demo subject as other systems' data: whole or unfinished, and what they have no place for."""

import resource
import signal
from pathlib import Path

import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import DiskError
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.exporters import DEMO_FORMATS, write_demo

_SMALL = DemoConfig(image_size=16, num_frames=2, num_test_frames=1, supersampling=1)


def test_what_was_interrupted_is_made_again_in_the_same_folder(tmp_path: Path):
    """The folder itself stays: a user may be in it."""
    folder = tmp_path / "me"
    folder.mkdir()
    place = folder.stat().st_ino

    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_demo(folder, "flashavatar", _SMALL, interrupt)
    assert [path.name for path in folder.iterdir()] == [".unfinished"]
    flame = write_demo(folder, "flashavatar", _SMALL)
    assert flame.is_file()
    assert flame.is_relative_to(folder)
    assert not (folder / ".unfinished").exists()
    assert folder.stat().st_ino == place
    assert [path.name for path in (folder / "metrical-tracker/output").iterdir()] == ["me"]
    assert len(list((folder / "imgs").iterdir())) == _SMALL.num_frames


@pytest.mark.parametrize("format", ["insta", "vhap"])
def test_what_the_disk_refuses_is_told(tmp_path: Path, format: str):
    """A limit of files' sizes refuses what a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

    def fill(done: int, total: int) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (64, hard))

    try:
        with pytest.raises(DiskError, match="Cannot write"):
            write_demo(tmp_path / "me", format, _SMALL, fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert [path.name for path in (tmp_path / "me").iterdir()] == [".unfinished"]


@pytest.mark.parametrize("format", DEMO_FORMATS)
def test_flame_has_no_shoulders(tmp_path: Path, format: str):
    with pytest.raises(UserError, match="has no shoulders: --body lean cannot be"):
        write_demo(tmp_path / "me", format, DemoConfig(body="lean"))
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_not_taken_for_a_folder(tmp_path: Path):
    (tmp_path / "me").write_text("mine")
    with pytest.raises(UserError, match="me is a file"):
        write_demo(tmp_path / "me", "insta", _SMALL)
