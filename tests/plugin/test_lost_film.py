"""An avatar outlives its film: what needs no frame of it works from the run alone."""

import shutil
from pathlib import Path

import pytest

from rgbavatar_ns.cli.main import main
from rgbavatar_ns.export.subject import load_subject
from tests.plugin.run import finished_run


def test_a_run_whose_film_is_gone_is_rendered_and_what_needs_it_says_so(
    tiny_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    data = shutil.copytree(tiny_data, tmp_path / "data")
    run = finished_run(data, tmp_path, max_num_iterations=2).parent
    before = load_subject(run, None)
    shutil.rmtree(data)
    after = load_subject(run, None, 24, 24)
    assert (after.dataset, after.lost) == (None, data)
    assert after.seen.num_frames == before.seen.num_frames
    words = ["--width", "24", "--height", "24"]
    main(["render", str(run), str(tmp_path / "out"), "--show", "turntable", *words])
    assert (tmp_path / "out" / "turntable.gif").exists()
    told = capsys.readouterr().out
    assert f"{data}, is not there" in told
    assert "--data names where they are now" in told
    with pytest.raises(SystemExit):
        main(["render", str(run), str(tmp_path / "out")])
    assert "A comparison needs the avatar's own dataset" in capsys.readouterr().err
