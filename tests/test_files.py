import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import (
    DiskError,
    Stages,
    atomic_folder,
    atomic_write,
    digest,
    digest_of_file,
    disk_errors,
    hold_lock,
    read_json,
    write_json,
)


def _names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_whole_under_its_name(tmp_path):
    target = tmp_path / "deep" / "film.mp4"
    with atomic_write(target) as partial:
        partial.write_text("new")
        assert not target.exists()
        assert partial.suffix == ".mp4"
    assert target.read_text() == "new"
    assert _names(target.parent) == ["film.mp4"]


def _write_half(target, failure, **options):
    with atomic_write(target, **options) as partial:
        partial.write_text("half")
        raise failure


@pytest.mark.parametrize("failure", [RuntimeError("a bug"), OSError(errno.EIO, "Input/output")])
def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, failure):
    target = tmp_path / "a.json"
    write_json(target, 1)
    with pytest.raises((RuntimeError, DiskError)):
        _write_half(target, failure)
    assert read_json(target) == 1
    assert _names(tmp_path) == ["a.json"]


@pytest.mark.parametrize(
    ("code", "told"),
    [
        (errno.ENOSPC, "There is no space left to write"),
        (errno.EDQUOT, "There is no space left to write"),
        (errno.EACCES, "Cannot write .*: Permission denied"),
    ],
)
def test_what_the_disk_refuses_is_told_with_the_remedy(tmp_path, monkeypatch, code, told):
    def refuse(source, target):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "replace", refuse)
    with (
        pytest.raises(DiskError, match=rf"{told}.*Mend it\."),
        atomic_write(tmp_path / "a", remedy="Mend it.") as partial,
    ):
        partial.write_text("a")
    assert _names(tmp_path) == []


def test_a_file_in_the_place_of_a_folder_is_told_as_one(tmp_path):
    (tmp_path / "notes").write_text("")
    with pytest.raises(DiskError, match=r"Cannot write .*notes/a\.json: .*notes is a file\."):
        write_json(tmp_path / "notes" / "a.json", 1)


@pytest.mark.parametrize("own", ["Free some space or name another place.", "Mend it."])
def test_the_remedy_is_that_of_who_knows_more_of_the_work(tmp_path, own):
    told = "Go on." if own != "Mend it." else own
    with (
        pytest.raises(DiskError, match=rf"Cannot write .*short write\. {told}"),
        disk_errors(tmp_path, "Go on."),
    ):
        _write_half(tmp_path / "a", RuntimeError("short write"), remedy=own, also=(RuntimeError,))


def test_errors_of_a_library_that_writes_are_the_disks(tmp_path):
    with pytest.raises(DiskError, match=r"Cannot write .*: short write"):
        _write_half(tmp_path / "a", RuntimeError("short write"), also=(RuntimeError,))


@pytest.mark.parametrize("write", [atomic_write, atomic_folder])
@pytest.mark.parametrize("place", [".", "/", ".."])
def test_a_place_without_a_name_is_told(write, place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="no name of something to write"), write(Path(place)):
        pass
    assert _names(tmp_path) == []


def test_a_folder_takes_the_place_of_an_older_one(tmp_path):
    for text in ("old", "new"):
        with atomic_folder(tmp_path / "set") as partial:
            assert _names(partial) == []
            (partial / text).write_text(text)
    assert _names(tmp_path / "set") == ["new"]
    assert _names(tmp_path) == ["set"]


def test_a_folder_that_fails_leaves_the_older_one(tmp_path):
    with atomic_folder(tmp_path / "set") as partial:
        (partial / "old").write_text("old")
    with pytest.raises(DiskError, match="no space left"), atomic_folder(tmp_path / "set"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert _names(tmp_path / "set") == ["old"]
    assert _names(tmp_path) == ["set"]


def test_a_folder_lost_between_two_moves_lies_beside_its_place(tmp_path, monkeypatch):
    with atomic_folder(tmp_path / "set") as partial:
        (partial / "old").write_text("old")
    move = Path.rename

    def fail_second(source, target):
        if source.name == ".set.partial":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return move(source, target)

    monkeypatch.setattr(Path, "rename", fail_second)
    for _ in range(2):
        with pytest.raises(DiskError), atomic_folder(tmp_path / "set"):
            pass
    assert _names(tmp_path) == [".set.old"]
    assert _names(tmp_path / ".set.old") == ["old"]


_HOLD = """
import pathlib, sys
from rgbavatar_ns.files import hold_lock
with hold_lock(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("end", ["close", "kill"])
def test_a_lock_is_waited_for_and_goes_with_its_process(tmp_path, end):
    lock = tmp_path / "lock"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", _HOLD, str(lock)], **pipes) as holder:
        assert holder.stdout.readline() == "held\n"
        waited = []

        def let_go():
            waited.append(holder.poll())
            holder.stdin.close() if end == "close" else holder.kill()

        with hold_lock(lock, let_go):
            assert holder.wait(60) == (0 if end == "close" else -9)
    assert waited == [None]
    with hold_lock(lock, lambda: pytest.fail("nobody holds it")):
        pass


def test_json_is_replaced_whole_and_what_is_no_json_is_nothing(tmp_path):
    target = tmp_path / "deep" / "summary.json"
    assert read_json(target) is None
    write_json(target, {"psnr": 30.5})
    write_json(target, {"psnr": 31.0, "who": "Zoë"})
    assert read_json(target) == {"psnr": 31.0, "who": "Zoë"}
    assert _names(target.parent) == ["summary.json"]
    target.write_text('{"psnr": 3')
    assert read_json(target) is None


def test_digests_tell_values_types_and_shapes_apart():
    values = np.arange(6, dtype=np.float32)
    alike = digest(["a", values.reshape(2, 3)[:, ::-1][:, ::-1]])
    assert alike == digest([b"a", values.reshape(2, 3)])
    others = (values, values.reshape(3, 2), values.view(np.int32).reshape(2, 3))
    assert len({alike, *(digest(["a", other]) for other in others)}) == 4


def test_a_files_digest_is_of_its_content(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    one.write_bytes(b"x" * 9_000_000)
    two.write_bytes(b"x" * 9_000_000)
    assert digest_of_file(one) == digest_of_file(two)
    two.write_bytes(b"x" * 8_999_999 + b"y")
    assert digest_of_file(one) != digest_of_file(two)
    with pytest.raises(UserError, match="cannot be read"):
        digest_of_file(tmp_path / "none")


def _run_two(folder, calls, settings="a", fresh=False, fail=False, **options):
    stages = Stages(folder, fresh=fresh, **options)

    def first(key):
        calls.append("first")
        return {"value": 1}

    def second(key):
        calls.append("second")
        if fail:
            raise RuntimeError("interrupted")
        return {"key": key}

    stages.run("first", {"s": settings}, first)
    return stages.run("second", {}, second)


def test_a_finished_stage_is_not_done_again(tmp_path):
    calls, told = [], []
    once = _run_two(tmp_path, calls)
    again = _run_two(tmp_path, calls, tell=lambda *facts: told.append(facts))
    assert calls == ["first", "second"]
    assert once == again
    assert [name for name, seconds in told if seconds is not None] == ["first", "second"]


def test_interrupted_work_goes_on_from_the_stage_it_was_in(tmp_path):
    calls = []
    with pytest.raises(RuntimeError):
        _run_two(tmp_path, calls, fail=True)
    _run_two(tmp_path, calls)
    assert calls == ["first", "second", "second"]


def test_changed_settings_redo_the_stage_and_all_after_it(tmp_path):
    calls = []
    keys = [_run_two(tmp_path, calls)["key"]]
    keys.append(_run_two(tmp_path, calls, settings="b")["key"])
    keys.append(_run_two(tmp_path, calls, settings="b", made_from="another film")["key"])
    assert calls == ["first", "second"] * 3
    assert len(set(keys)) == 3


def test_a_stage_that_was_begun_anew_and_interrupted_is_not_done(tmp_path):
    """Whoever asks as at first again finds data that is half replaced."""
    calls = []
    _run_two(tmp_path, calls)

    def interrupted(key):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Stages(tmp_path).run("first", {"s": "b"}, interrupted)
    assert Stages(tmp_path).known("first") is None
    _run_two(tmp_path, calls)
    assert calls == ["first", "second", "first"]


def test_what_fresh_work_was_interrupted_in_is_not_done_either(tmp_path):
    calls = []
    _run_two(tmp_path, calls)

    def interrupted(key):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Stages(tmp_path, fresh=True).run("first", {"s": "a"}, interrupted)
    _run_two(tmp_path, calls)
    assert calls == ["first", "second"] * 2


def test_a_record_of_before_still_counts(tmp_path):
    """The keys are part of the format."""
    result = {"key": "c081e75ff0", "seconds": 1.0, "result": {"data": "x"}}
    (tmp_path / "stages.json").write_text(json.dumps({"track": result}))
    stages = Stages(tmp_path)
    assert stages.run("track", {"size": 8}, lambda key: key) == {"data": "x"}


@pytest.mark.parametrize("broken", ["{ half", "[]"])
def test_fresh_or_a_broken_record_counts_as_nothing_done(tmp_path, broken):
    calls = []
    _run_two(tmp_path, calls)
    _run_two(tmp_path, calls, fresh=True)
    (tmp_path / "stages.json").write_text(broken)
    _run_two(tmp_path, calls)
    assert calls == ["first", "second"] * 3


_WITHOUT_FCNTL = """
import importlib, pkgutil, sys
sys.modules["fcntl"] = None
import rgbavatar_ns.data
for module in pkgutil.walk_packages(rgbavatar_ns.__path__, "rgbavatar_ns."):
    importlib.import_module(module.name)
"""


@pytest.mark.slow
def test_every_module_imports_where_there_is_no_fcntl():
    """As on Windows."""
    subprocess.run([sys.executable, "-W", "ignore", "-c", _WITHOUT_FCNTL], check=True, timeout=300)
