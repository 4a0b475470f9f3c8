"""Sections one after another, each in a process that is left behind where it does not end."""

import json
import os
import select
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import IO, Any

from benchmarks.gpu.report import BAD, Report
from benchmarks.gpu.sections import PREFLIGHT, SMOKE, Section

Command = Callable[[Section, int], Sequence[str]]
"""How a section's process is started, with the number of the open file that takes its rows."""

_LEAST_S = 3.0
"""What a section is begun for."""
_LOOK_S = 0.5
_TAIL_CHARACTERS = 3000


@dataclass(frozen=True)
class Patience:
    """Seconds that a process is given: to end by itself after its last row, and when told to."""

    to_end_s: float = 10.0
    to_terminate_s: float = 2.0
    to_be_killed_s: float = 3.0


@dataclass(frozen=True)
class Runner:
    """Asks sections and reports; each ends with a state, come what may.

    Attributes:
        command: starts a section's process.
        budget_s: seconds for all sections.
        clock: seconds; an argument so that tests wait for nothing.
    """

    report: Report
    command: Command
    budget_s: float
    patience: Patience = Patience()
    clock: Callable[[], float] = time.monotonic

    def run(self, sections: Sequence[Section]) -> None:
        """Ask all sections.

        Where the preflight says that there is nothing to ask, the others are not run. After a
        failed smoke test those that explain it come first. A KeyboardInterrupt, raised by a
        signal's handler, passes when all have a state.
        """
        start, waiting, report = self.clock(), list(sections), self.report
        try:
            while waiting:
                section = waiting[0]
                left_s = self.budget_s - (self.clock() - start)
                why = self._reason_against(left_s)
                if why is None:
                    self._run(section, min(section.limit_s, left_s))
                else:
                    report.end(section.name, "not run", why=why)
                waiting.remove(section)
                if section.name == SMOKE and SMOKE in report.failed():
                    waiting.sort(key=lambda each: not each.explains)
        except KeyboardInterrupt:
            for section in waiting:
                begun = section.name in report.sections
                why = None if begun else "interrupted"
                report.end(section.name, "interrupted" if begun else "not run", why=why)
            raise

    def _reason_against(self, left_s: float) -> str | None:
        """Why nothing more is begun; None where it can be."""
        preflight = self.report.sections.get(PREFLIGHT, {}).get("rows", {})
        missing = preflight.get("verdict", {}).get("missing")
        if missing:
            return "the preflight misses " + ", ".join(missing)
        spent = left_s < _LEAST_S
        return f"the budget of {self.budget_s:g} s is spent" if spent else None

    def _late(self, section: Section, limit_s: float, heard: bool) -> tuple[str, str]:
        """The state of a section that did not end; where it had less than its time, that is why."""
        late = "it had told all and did not end" if heard else "it did not end"
        enough_s = self.patience.to_end_s if heard else section.limit_s
        rows = self.report.sections[section.name]["rows"]
        if limit_s >= enough_s or _failed(rows):
            return "timed out", f"{late} within {limit_s:.0f} s"
        return "cut short", f"{late} within the {limit_s:.0f} s that the budget left"

    def _run(self, section: Section, limit_s: float) -> None:
        """One section, to its state."""
        name, start, report, patience = section.name, self.clock(), self.report, self.patience
        report.begin(name, limit_s)
        with (
            tempfile.TemporaryFile() as log,
            _process(section, self.command, log, patience) as (process, rows),
        ):
            listener = _Listener(name, report)
            heard = listener.listen(process, rows, lambda: start + limit_s - self.clock())
            ended = heard and _waited(process, min(patience.to_end_s, limit_s))
            left_behind = None if ended else _leave(process, patience)
            if ended:
                _end_group(process)
                state, why = _judge(process.returncode, report.sections[name]["rows"])
            else:
                state, why = self._late(section, limit_s, heard)
            if section.guest and state in BAD:
                state, why = "left out", f"{state}: {why}"
            if left_behind is not None:
                why = f"{why}; process {left_behind} cannot be ended and may slow what follows"
            report.end(
                name,
                state,
                why=why,
                doing=listener.doing,
                left_behind=left_behind,
                log=None if state == "done" else _tail(log),
                seconds=round(self.clock() - start, 1),
            )


@contextmanager
def _process(
    section: Section, command: Command, log: IO[bytes], patience: Patience
) -> Iterator[tuple["subprocess.Popen[bytes]", int]]:
    """The section's process, head of a group of its own, and the open file of its rows.

    An interruption ends it.
    """
    rows, written = os.pipe()
    try:
        try:
            process = subprocess.Popen(
                command(section, written),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                pass_fds=(written,),
                start_new_session=True,
            )
        finally:
            os.close(written)
        try:
            yield process, rows
        except KeyboardInterrupt:
            _leave(process, patience)
            raise
    finally:
        os.close(rows)


class _Listener:
    """Takes a process's messages into the report."""

    def __init__(self, section: str, report: Report) -> None:
        self._section, self._report, self._text = section, report, b""
        self.doing: str | None = None
        """The row that was begun and has not come."""

    def listen(
        self, process: "subprocess.Popen[bytes]", rows: int, seconds_left: Callable[[], float]
    ) -> bool:
        """Take messages until there are no more; False where that takes too long."""
        while (left_s := seconds_left()) > 0:
            over = process.poll() is not None
            ready, _, _ = select.select([rows], [], [], 0 if over else min(left_s, _LOOK_S))
            if ready:
                chunk = os.read(rows, 1 << 16)
                if not chunk:
                    return True
                self._take(chunk)
            elif over:  # one that it started holds the file open
                return True
        return False

    def _take(self, chunk: bytes) -> None:
        *lines, self._text = (self._text + chunk).split(b"\n")
        for line in lines:
            message = json.loads(line)
            self.doing = message.get("begin")
            if "row" in message:
                self._report.row(self._section, message["row"], message["figures"])


def _judge(status: int, rows: dict[str, Any]) -> tuple[str, str | None]:
    """The state of a section whose process has ended, and why it is that."""
    failed = _failed(rows)
    if status < 0:
        return "died", f"by {_signal_name(-status)}"
    if failed:
        return "failed", ", ".join(failed)
    if status > 0:
        return "died", f"with exit status {status}; see its log"
    left_out = [figures["left_out"] for figures in rows.values() if "left_out" in figures]
    return ("left out", left_out[0]) if left_out else ("done", None)


def _failed(rows: dict[str, Any]) -> list[str]:
    return [name for name, figures in rows.items() if "failed" in figures]


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _leave(process: "subprocess.Popen[bytes]", patience: Patience) -> int | None:
    """End a process and what it started; its number where even that does not end it.

    A process that waits for a hung driver cannot be ended, and is not waited for.
    """
    for how, seconds in (
        (signal.SIGTERM, patience.to_terminate_s),
        (signal.SIGKILL, patience.to_be_killed_s),
    ):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, how)
        if _waited(process, seconds):
            _end_group(process)
            return None
    return process.pid


def _end_group(process: "subprocess.Popen[bytes]") -> None:
    """End what a process that has ended started and left."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _waited(process: "subprocess.Popen[bytes]", seconds: float) -> bool:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return False
    return True


def _tail(log: IO[bytes]) -> str | None:
    log.seek(0, os.SEEK_END)
    log.seek(max(0, log.tell() - _TAIL_CHARACTERS))
    return log.read().decode(errors="replace").strip() or None
