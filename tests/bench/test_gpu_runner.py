"""What becomes of sections that end, hang, die or are not reached; none of them needs a GPU."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.gpu import runner as runners
from benchmarks.gpu.child import run_section
from benchmarks.gpu.report import Report
from benchmarks.gpu.rows import LeftOut, Rows, SectionEnded, check
from benchmarks.gpu.runner import Patience, Runner
from benchmarks.gpu.sections import SECTIONS, Section, chosen_sections

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "benchmarks" / "gpu_check.py"
TELL = """
import json, os, signal, sys, time
def say(**message): os.write(int(sys.argv[1]), (json.dumps(message) + chr(10)).encode())
say(begin="first"); say(row="first", figures={"number": 1}); say(begin="second")
"""
# One message, since the test's clock may jump as soon as the row has come.
HANG = "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
HANG += "say(row='deaf', figures={}, begin='second')\nwhile True: time.sleep(60)"
CODES = {
    "ends": "say(row='second', figures={'number': 2})",
    "fails": "say(row='second', figures={'failed': 'it is 3'})",
    "lacks": "say(row='second', figures={'left_out': 'no tool', 'remedy': 'get it'})",
    "dies": "os.kill(os.getpid(), signal.SIGKILL)",
    "raises": "raise RuntimeError('out of luck')",
    "hangs": HANG,
}


def stub(section: Section, rows_file: int) -> list[str]:
    return [sys.executable, "-S", "-c", TELL + CODES[section.place], str(rows_file)]


def sections(*codes: str) -> list[Section]:
    return [Section(code, code, "a stub", 100.0) for code in codes]


class WatchedReport(Report):
    """Reads its file after every change."""

    def _save(self) -> None:
        super()._save()
        assert json.loads(self._path.read_text())["sections"] == self.sections


@pytest.fixture
def report(tmp_path):
    return WatchedReport(tmp_path / "made" / "gpu.json")


def late_once(report: Report, name: str, row: str, seconds: float = 1000.0):
    """A clock that jumps far ahead when that row has come."""
    return lambda: seconds * (row in report.sections.get(name, {}).get("rows", {}))


def test_states_of_sections_that_end(report, capsys):
    Runner(report, stub, 1e6).run(sections("ends", "fails", "lacks", "dies", "raises"))
    found = report.sections
    assert {name: each["state"] for name, each in found.items()} == {
        "ends": "done",
        "fails": "failed",
        "lacks": "left out",
        "dies": "died",
        "raises": "died",
    }
    assert found["ends"]["rows"] == {"first": {"number": 1}, "second": {"number": 2}}
    assert found["fails"]["why"] == "second"
    assert found["lacks"]["why"] == "no tool"
    assert "SIGKILL" in found["dies"]["why"]
    assert found["dies"]["doing"] == "second"
    assert "out of luck" in found["raises"]["log"]
    assert report.failed() == ["fails", "dies", "raises"]
    assert 'ends.second: {"number": 2}' in capsys.readouterr().out


def test_what_hangs_is_left_behind_and_the_next_section_runs(report):
    clock = late_once(report, "hangs", "deaf")
    patience = Patience(to_terminate_s=0.1)  # it ignores being told to end
    Runner(report, stub, 1e6, patience, clock).run(sections("hangs", "ends"))
    hung = report.sections["hangs"]
    assert hung["state"] == "timed out"
    assert hung["why"] == "it did not end within 100 s"
    assert hung["doing"] == "second"
    assert "first" in hung["rows"]
    assert "left_behind" not in hung
    assert report.sections["ends"]["state"] == "done"


def test_a_guest_s_failure_is_none_of_ours(report):
    Runner(report, stub, 1e6).run([Section("dies", "dies", "a stub", 100.0, guest=True)])
    assert report.sections["dies"]["state"] == "left out"
    assert report.sections["dies"]["why"] == "died: by SIGKILL"
    assert report.failed() == []


STUCK = f"""
import sys, time, types
sys.path.insert(0, {str(ROOT)!r})
from benchmarks.gpu.child import child
from benchmarks.gpu.sections import Section
def a_kernel_without_end(rows):
    with rows.row("ready"):
        pass
    while True:
        time.sleep(60)
sys.modules["benchmarks.gpu.stuck"] = module = types.ModuleType("stuck")
module.question = a_kernel_without_end
child(Section("stuck", "stuck:question", "", 1.0), int(sys.argv[1]))
"""


def test_a_process_that_is_told_to_end_says_where_it_was(report):
    def command(section: Section, rows_file: int) -> list[str]:
        return [sys.executable, "-S", "-c", STUCK, str(rows_file)]

    clock = late_once(report, "stuck", "ready")
    Runner(report, command, 1e6, clock=clock).run(sections("stuck"))
    stuck = report.sections["stuck"]
    assert stuck["state"] == "timed out"
    assert "a_kernel_without_end" in stuck["log"]


def test_what_cannot_be_killed_is_told_and_not_waited_for(report, monkeypatch):
    monkeypatch.setattr(runners.os, "killpg", lambda group, how: None)
    clock = late_once(report, "hangs", "deaf")
    Runner(report, stub, 1e6, Patience(1, 0, 0), clock).run(sections("hangs", "ends"))
    monkeypatch.undo()
    hung = report.sections["hangs"]
    try:
        assert hung["state"] == "timed out"
        assert f"process {hung['left_behind']} cannot be ended" in hung["why"]
        assert report.sections["ends"]["state"] == "done"
    finally:
        os.killpg(hung["left_behind"], signal.SIGKILL)


def test_a_spent_budget_names_what_is_not_run(report):
    clock = late_once(report, "ends", "second", 899.0)
    asked = [Section("ends", "ends", "", 1e6), *sections("fails", "dies")]
    Runner(report, stub, 900.0, clock=clock).run(asked)
    assert report.sections["ends"]["state"] == "done"
    for name in ("fails", "dies"):
        assert report.sections[name]["state"] == "not run"
        assert "budget of 900 s" in report.sections[name]["why"]
    assert report.failed() == []


def test_a_section_gets_no_more_than_is_left_of_the_budget(report):
    Runner(report, stub, 50.0).run(sections("ends"))
    assert 0 < report.sections["ends"]["limit_s"] <= 50


def test_what_the_budget_cuts_short_has_not_failed(report):
    asked = [Section("hangs", "hangs", "", 100.0), *sections("ends")]
    clock = late_once(report, "hangs", "deaf")
    Runner(report, stub, 50.0, Patience(to_terminate_s=0.1), clock).run(asked)
    assert report.sections["hangs"]["state"] == "cut short"
    assert report.sections["hangs"]["why"] == "it did not end within the 50 s that the budget left"
    assert report.sections["ends"]["state"] == "not run"
    assert report.failed() == []


def test_what_fails_before_the_budget_cuts_it_short_stays_a_failure(report, monkeypatch):
    monkeypatch.setitem(CODES, "wrong", CODES["fails"] + "\n" + CODES["hangs"])
    clock = late_once(report, "wrong", "deaf")
    Runner(report, stub, 50.0, Patience(to_terminate_s=0.1), clock).run(sections("wrong"))
    assert report.failed() == ["wrong"]


def test_without_what_the_preflight_misses_nothing_else_is_asked(report):
    verdict = "say(row='verdict', figures={'missing': ['torch', 'NVRTC']})"
    codes = {"preflight": verdict, "smoke": CODES["ends"]}

    def command(section: Section, rows_file: int) -> list[str]:
        return [sys.executable, "-S", "-c", TELL + codes[section.name], str(rows_file)]

    Runner(report, command, 1e6).run(SECTIONS[:2])
    assert report.sections["preflight"]["state"] == "done"
    assert report.sections["smoke"] == {
        "state": "not run",
        "why": "the preflight misses torch, NVRTC",
    }


def test_after_a_failed_smoke_test_what_explains_it_comes_first(report):
    asked = [
        Section("smoke", "fails", "", 100),
        *sections("ends", "lacks"),
        Section("memcheck", "ends", "", 100, explains=True),
    ]
    Runner(report, stub, 1e6).run(asked)
    assert list(report.sections) == ["smoke", "memcheck", "ends", "lacks"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_keeps_what_was_found(tmp_path, number):
    """The whole command is told to end while a section hangs, which ends as well."""
    path = tmp_path / "gpu.json"
    stand_in = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from benchmarks import gpu_check
from tests.bench.test_gpu_runner import sections, stub
gpu_check.chosen_sections = lambda names: sections("ends", "hangs", "fails")
gpu_check.own_command = stub
sys.exit(gpu_check.main(["--json", {str(path)!r}]))
"""
    command = [sys.executable, "-c", stand_in]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "hangs.deaf" in line:
                process.send_signal(number)
        assert process.wait() == 130
    found = json.loads(path.read_text())["sections"]
    assert found["ends"]["rows"]["second"] == {"number": 2}
    assert found["hangs"]["state"] == "interrupted"
    assert "first" in found["hangs"]["rows"]
    assert found["fails"] == {"state": "not run", "why": "interrupted"}


def test_a_file_that_cannot_be_written_is_told_before_anything_is_asked(tmp_path):
    (tmp_path / "file").write_text("")
    command = [sys.executable, str(SCRIPT), "--json", str(tmp_path / "file" / "gpu.json")]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 2
    assert "cannot be written" in ran.stderr
    assert "--json" in ran.stderr


def test_sections_are_listed_and_chosen_by_name():
    ran = subprocess.run([sys.executable, str(SCRIPT), "--list"], capture_output=True, text=True)
    assert [line.split()[0] for line in ran.stdout.splitlines()] == [s.name for s in SECTIONS]
    assert [s.name for s in chosen_sections("ncu, smoke")] == ["smoke", "ncu"]
    for wrong in ("smoke,xyz", ""):
        with pytest.raises(ValueError, match="There is no section"):
            chosen_sections(wrong)


def test_what_is_raised_between_rows_becomes_one():
    lines: list[str] = []
    run_section(Section("gone", "no_such_module:anything", "", 1.0), Rows(lines.append))
    assert "no_such_module" in json.loads(lines[-1])["figures"]["failed"]


def test_rows_are_valid_json_and_say_why_a_section_ends_early():
    lines: list[str] = []
    rows = Rows(lines.append)
    with rows.row("odd") as figures:
        figures |= {"nothing": float("nan"), "third": 1 / 3, "path": Path("a"), "list": [1.0, None]}
        check(figures, True, "never said")
        check(figures, False, "one")
        check(figures, False, "two")
    with pytest.raises(SectionEnded), rows.row("broken"):
        raise RuntimeError("an illegal access")
    with pytest.raises(SectionEnded), rows.row("absent"):
        raise LeftOut("There is no ncu.", "Install it.")
    told = [json.loads(line, parse_constant=pytest.fail) for line in lines]
    assert [message.get("begin") for message in told[::2]] == ["odd", "broken", "absent"]
    assert told[1]["figures"] == {
        "nothing": "nan",
        "third": 0.333333,
        "path": "a",
        "list": [1.0, None],
        "failed": "one; two",
    }
    assert told[3]["figures"] == {"failed": "RuntimeError: an illegal access"}
    assert told[5]["figures"] == {"left_out": "There is no ncu.", "remedy": "Install it."}
