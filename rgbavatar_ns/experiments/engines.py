"""Who runs the cells: processes of this machine, or a Ray cluster."""

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import suppress
from pathlib import Path
from types import ModuleType

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.runner import LOG_FILE

_SECONDS_TO_SAVE = 60.0
_RUNNER = (sys.executable, "-m", "rgbavatar_ns.experiments.runner")

Finished = Callable[[Path, int], None]
"""Called in the sweep's thread with a cell's folder and its exit code."""


class LocalEngine:
    """Child processes of this machine, `at_once` at a time.

    `side_by_side` says whether cells may share a machine, and with it their seconds.
    """

    def __init__(self, at_once: int = 1) -> None:
        if at_once < 1:
            raise UserError(f"{at_once} cells at once are impossible.", "Pass --at-once 1 or more.")
        self._at_once = at_once
        self.side_by_side = at_once > 1
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def run(self, folders: Sequence[Path], finished: Finished) -> None:
        """Return when all have ended; Ctrl-C lets those that run save, and ends."""
        with ThreadPoolExecutor(self._at_once) as workers:
            waiting = {workers.submit(self._run_one, folder): folder for folder in folders}
            try:
                for future in as_completed(waiting):
                    finished(waiting[future], future.result())
            except BaseException:
                self._stop(list(waiting))
                raise

    def _run_one(self, folder: Path) -> int:
        with self._lock:
            if self._stopped:
                return 130
            with (folder / LOG_FILE).open("ab") as log:
                process = start_cell(folder, log.fileno())
            self._running.add(process)
        code = process.wait()
        with self._lock:
            self._running.discard(process)
        return code

    def _stop(self, waiting: list[Future[int]]) -> None:
        with self._lock:
            self._stopped = True
            running = list(self._running)
        for future in waiting:
            future.cancel()
        end_cells(running)


def start_cell(folder: Path, log: int) -> "subprocess.Popen[bytes]":
    """The cell's process, leader of a group of its own: a signal reaches ns-train once, from us."""
    return subprocess.Popen(
        [*_RUNNER, str(folder), str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        start_new_session=True,
    )


def end_cells(processes: "Sequence[subprocess.Popen[bytes]]") -> None:
    """Interrupt all cells and what is below them; kill what has not saved within a minute."""
    for number, seconds in ((signal.SIGINT, _SECONDS_TO_SAVE), (signal.SIGKILL, 5.0)):
        running = [process for process in processes if process.poll() is None]
        for process in running:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, number)
        until_s = time.monotonic() + seconds
        for process in running:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, until_s - time.monotonic()))


class RayEngine:
    """Tasks of a Ray cluster (`address`, or one started here), which retries where a node is lost.

    Folders are on storage that all nodes share. Each cell asks for `cpus` and `gpus`.
    """

    def __init__(self, address: str | None, cpus: float, gpus: float) -> None:
        self._ray = _load_ray()
        self._ray.init(address=address, ignore_reinit_error=True, log_to_driver=False)
        self._resources = {"num_cpus": cpus, "num_gpus": gpus}
        self.side_by_side = True  # as many on a node as it has room for

    def run(self, folders: Sequence[Path], finished: Finished) -> None:
        """As `LocalEngine.run`."""
        # A node that dies ends the task, not the cell's exit code: Ray starts it anew elsewhere.
        task = self._ray.remote(max_retries=3, **self._resources)(_run_on_node)
        waiting = {task.remote(str(folder)): folder for folder in folders}
        try:
            while waiting:
                done, _ = self._ray.wait(list(waiting), num_returns=1)
                for reference in done:
                    finished(waiting.pop(reference), self._result(reference))
        except BaseException:
            for reference in waiting:
                self._ray.cancel(reference)
            raise

    def _result(self, reference: object) -> int:
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayError:
            return 1


Engine = LocalEngine | RayEngine
"""Runs cells that are described in folders, some at a time."""


def _run_on_node(folder: str) -> int:
    with (Path(folder) / LOG_FILE).open("ab") as log:
        process = start_cell(Path(folder), log.fileno())
    try:
        return process.wait()
    except BaseException:
        end_cells([process])
        raise


def _load_ray() -> ModuleType:
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise UserError(
            f"The engine `ray` needs Ray, which cannot be imported ({error}).",
            "Install it (pip install 'ray>=2.9'), or use --engine local.",
        ) from error
