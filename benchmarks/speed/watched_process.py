"""A command as a process of its own: how much memory it has at each moment, and its time."""

import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

_BIN = Path(sys.executable).parent
_EVERY_S = 0.05
_MIB = 1 << 20


@dataclass
class MemoryCurve:
    """Resident memory of a process and all that it started, MiB, at moments of `time.monotonic`."""

    moments: list[tuple[float, float]] = field(default_factory=list)

    def sample(self, process: psutil.Process) -> None:
        """Look once; processes that end meanwhile have nothing."""
        total = 0
        for one in self._family(process):
            try:
                total += one.memory_info().rss
            except psutil.Error:
                continue
        self.moments.append((time.monotonic(), total / _MIB))

    def peak_mib(self, began_s: float = -float("inf"), ended_s: float = float("inf")) -> float:
        """The most between two moments."""
        return max((mib for at, mib in self.moments if began_s <= at <= ended_s), default=0.0)

    @staticmethod
    def _family(process: psutil.Process) -> list[psutil.Process]:
        try:
            return [process, *process.children(recursive=True)]
        except psutil.Error:
            return []


@dataclass(frozen=True)
class Watched:
    """How a command went: `cpu_s` are the seconds of all its threads and processes."""

    began_s: float
    clock_s: float
    cpu_s: float
    memory: MemoryCurve


def watch(words: list[str], log: Path) -> Watched:
    """Run a command of this environment; exits with the end of what it says where it fails."""
    began, memory = time.monotonic(), MemoryCurve()
    with log.open("w") as told:
        process = subprocess.Popen(
            [str(_BIN / words[0]), *words[1:]], stdout=told, stderr=subprocess.STDOUT
        )
        handle = psutil.Process(process.pid)
        used: Any = None
        pid = status = 0
        while pid == 0:
            memory.sample(handle)
            time.sleep(_EVERY_S)
            pid, status, used = os.wait4(process.pid, os.WNOHANG)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        said = log.read_text(errors="replace")[-1500:]
        sys.exit(f"{' '.join(words)} ended with {process.returncode}: {said}")
    clock_s = time.monotonic() - began
    return Watched(began, clock_s, used.ru_utime + used.ru_stime, memory)
