import errno
import json
import tempfile

import pytest

from rgbavatar_ns.cli import main as cli

TINY = ["--size", "64", "--repetitions", "1"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["rasterizer", "--count", "300", "--batch", "2", "--peer-repetitions", "1"], "images/s"),
        (["step", "--uv", "24", "--bases", "2", "--batch", "2"], "whole step"),
        (["render", "--uv", "24", "--bases", "2"], "frames/s"),
    ],
)
def test_figures_are_printed_and_written(arguments, told, tmp_path, capsys):
    path = tmp_path / "new folder" / "out.json"
    cli.main(["bench", *arguments, *TINY, "--json", str(path)])
    printed = capsys.readouterr().out
    assert told in printed
    assert "roofline" in printed
    assert "reached" in printed
    figures = json.loads(path.read_text())
    assert figures["benchmark"] == arguments[0]
    assert figures["images_per_second"] > 0
    if arguments[0] == "rasterizer":
        assert set(figures["peers"]) == {"gsplat torch"}
        assert "gsplat torch" in printed


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["rasterizer", "--repetitions", "0"], "--repetitions is 0"),
        (["step", "--avatar", "/no/such/avatar"], "/no/such/avatar"),
        (["render", "--json", "/proc/none/out.json"], "/proc/none/out.json"),
    ],
)
def test_a_mistake_is_told_in_one_line(arguments, cause, refused):
    told = refused("bench", *arguments)
    assert cause in told
    assert len(told.strip().splitlines()) == 1


def test_a_place_that_refuses_is_told_by_the_name_that_was_given(refused, monkeypatch, tmp_path):
    def refuse(dir):
        raise OSError(errno.EROFS, "Read-only file system", f"{dir}/tmp_of_python")

    monkeypatch.setattr(tempfile, "TemporaryFile", refuse)
    path = tmp_path / "out.json"
    told = refused("bench", "render", "--json", path)
    assert f"Cannot write {path}: Read-only file system." in "".join(told.splitlines())
    assert "tmp_of_python" not in told
