"""What was found, printed as it comes and whole on the disk at every moment."""

import json
import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks.gpu.rows import Figures

BAD = ("failed", "timed out", "died")
"""States of a section that make the whole fail."""


class Report:
    """Sections by name, each with its state and rows, in a file that is replaced after each row.

    Made of the standard library alone: it must tell of a machine where nothing else is. Raises
    OSError where the file cannot be written at the start; later that is told once, and printing
    goes on.
    """

    def __init__(self, path: Path, **facts: Any) -> None:
        self._path, self._start = path, time.monotonic()
        self._facts = {"started": time.strftime("%Y-%m-%d %H:%M:%S"), **facts}
        self.sections: dict[str, dict[str, Any]] = {}
        self._told = False
        path.parent.mkdir(parents=True, exist_ok=True)
        self._write()

    def begin(self, name: str, limit_s: float) -> None:
        """A section is on its way."""
        self.sections[name] = {"state": "running", "limit_s": round(limit_s, 1), "rows": {}}
        self._print(f"{name}: at most {limit_s:.0f} s ...")
        self._save()

    def row(self, section: str, name: str, figures: Figures) -> None:
        """A row of the section has come."""
        self.sections[section]["rows"][name] = figures
        self._print(f"{section}.{name}: {json.dumps(figures)}")
        self._save()

    def end(self, name: str, state: str, **more: Any) -> None:
        """The section is over, or was never begun."""
        known = {key: value for key, value in more.items() if value is not None}
        self.sections.setdefault(name, {}).update(state=state, **known)
        why = known.get("why")
        self._print(f"{name}: {state}" + (f": {why}" if why else ""))
        self._save()

    def failed(self) -> list[str]:
        """The sections that make the whole fail."""
        return [name for name, found in self.sections.items() if found["state"] in BAD]

    def _print(self, line: str) -> None:
        with suppress(BrokenPipeError):  # nobody listens any more; the file tells
            print(f"[{time.monotonic() - self._start:4.0f} s] {line}", flush=True)

    def _save(self) -> None:
        try:
            self._write()
        except OSError as error:
            if not self._told:
                print(f"{self._path} cannot be written any more: {error}", file=sys.stderr)
            self._told = True

    def _write(self) -> None:
        """As `rgbavatar_ns.files.atomic_write`, which needs what may be missing here."""
        seconds = round(time.monotonic() - self._start, 1)
        found = {**self._facts, "seconds": seconds, "sections": self.sections}
        partial = self._path.with_name(f".{self._path.name}.partial")
        partial.write_text(json.dumps(found, indent=1))
        os.replace(partial, self._path)
