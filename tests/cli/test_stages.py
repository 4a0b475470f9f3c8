import json

import pytest

from rgbavatar_ns.cli.stages import Stages
from rgbavatar_ns.data.json_file import write_json


def run_two(folder, calls, settings="a", fresh=False, fail=False):
    stages = Stages(folder, fresh)

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
    calls = []
    once = run_two(tmp_path, calls)
    again = run_two(tmp_path, calls)
    assert calls == ["first", "second"]
    assert once == again


def test_an_interrupted_command_goes_on_from_the_stage_it_was_in(tmp_path):
    calls = []
    with pytest.raises(RuntimeError):
        run_two(tmp_path, calls, fail=True)
    run_two(tmp_path, calls)
    assert calls == ["first", "second", "second"]


def test_changed_settings_redo_the_stage_and_all_after_it(tmp_path):
    calls = []
    before = run_two(tmp_path, calls)
    after = run_two(tmp_path, calls, settings="b")
    assert calls == ["first", "second"] * 2
    assert before["key"] != after["key"]


def test_fresh_redoes_everything(tmp_path):
    calls = []
    run_two(tmp_path, calls)
    run_two(tmp_path, calls, fresh=True)
    assert calls == ["first", "second"] * 2


def test_a_broken_record_counts_as_nothing_done(tmp_path):
    (tmp_path / "stages.json").write_text("{ half")
    calls = []
    run_two(tmp_path, calls)
    assert calls == ["first", "second"]


def test_json_is_replaced_whole(tmp_path):
    target = tmp_path / "deep" / "summary.json"
    write_json(target, {"psnr": 30.5})
    write_json(target, {"psnr": 31.0})
    assert json.loads(target.read_text()) == {"psnr": 31.0}
    assert [p.name for p in target.parent.iterdir()] == ["summary.json"]
