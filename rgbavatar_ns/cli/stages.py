"""Stages of a longer command: each is done once, and an interrupted command goes on from it."""

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from rgbavatar_ns.data.json_file import write_json

Result = dict[str, Any]


class Stages:
    """Runs stages in order and remembers their results in `folder/stages.json`.

    A stage is done again when its settings, or those of a stage before it, have changed.
    """

    def __init__(self, folder: Path, fresh: bool = False) -> None:
        self.folder = folder
        self.seconds: dict[str, float] = {}
        self._path = folder / "stages.json"
        self._chain = ""
        self._console = Console()
        folder.mkdir(parents=True, exist_ok=True)
        self._done: dict[str, Result] = {} if fresh else self._read()

    def _read(self) -> dict[str, Result]:
        try:
            return json.loads(self._path.read_text())
        except (OSError, ValueError):
            return {}

    def run(
        self, name: str, settings: Mapping[str, Any], action: Callable[[str], Result]
    ) -> Result:
        """Return the stage's result: remembered, or from `action(key)`, where key names it.

        The key is a hash of these settings and of all earlier stages' settings; the result must
        be what JSON can hold.
        """
        text = json.dumps([self._chain, name, settings], sort_keys=True, default=str)
        self._chain = hashlib.sha256(text.encode()).hexdigest()[:10]
        known = self._done.get(name)
        if known is not None and known["key"] == self._chain:
            self._console.print(f"[dim]{name}: done before ({known['seconds']:.0f} s)[/dim]")
        else:
            self._console.rule(name)
            started = time.monotonic()
            result = action(self._chain)
            known = {
                "key": self._chain,
                "seconds": time.monotonic() - started,
                "result": result,
            }
            self._done[name] = known
            write_json(self._path, self._done)
        self.seconds[name] = known["seconds"]
        return known["result"]
