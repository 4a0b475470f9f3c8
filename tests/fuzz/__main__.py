"""Hostile inputs in numbers: `python -m tests.fuzz --count 10000 --seed 0` prints a table.

Each module beside this one that has `cases(seed, count)` runs in a process of its own, so that a
crash or a hang is told too. An attack ends well if it is refused with a UserError, or changes
nothing; a traceback, a silent difference, more than SECONDS or more than MEMORY is a fault.
"""

import argparse
import importlib
import json
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

import tests.fuzz
from rgbavatar_ns.errors import UserError

SECONDS, MEMORY_BYTES, HANGS_SECONDS = 2.0, 1 << 30, 60


def kinds() -> list[str]:
    """The modules with attacks."""
    (folder,) = map(Path, tests.fuzz.__path__)
    found = (path.stem for path in folder.glob("*.py") if "\ndef cases(" in path.read_text())
    return sorted(found)


def attack(kind: str, seed: int, count: int, report: Path) -> None:
    """Run one module's attacks and write what came of them; the last one's name at any time."""
    module = importlib.import_module(f"tests.fuzz.{kind}")
    told = {"name": module.NAME, "refused": 0, "unharmed": 0, "faults": [], "slowest_s": 0.0}
    memory = peak_bytes()
    signal.signal(signal.SIGALRM, _hangs)
    for name, act in module.cases(seed, count):
        report.write_text(json.dumps(told | {"last": name}))
        signal.alarm(HANGS_SECONDS)
        started, fault = time.monotonic(), None
        try:
            act()
            told["unharmed"] += 1
        except UserError:
            told["refused"] += 1
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            fault = f"{type(error).__name__}: {str(error)[:150]} ({where.filename}:{where.lineno})"
        signal.alarm(0)
        seconds, now = time.monotonic() - started, peak_bytes()
        told["slowest_s"] = max(told["slowest_s"], seconds)
        if fault is None and seconds > SECONDS:
            fault = f"took {seconds:.1f} s"
        if fault is None and now - memory > MEMORY_BYTES:
            fault = f"took {(now - memory) / 2**20:.0f} MiB"
        memory = now
        if fault is not None:
            told["faults"].append([name, fault])
    report.write_text(json.dumps(told | {"last": None, "peak_bytes": peak_bytes()}))


def peak_bytes() -> int:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _hangs(number: int, frame: object) -> None:
    raise TimeoutError(f"hangs for {HANGS_SECONDS} s")


def run(names: list[str], seed: int, count: int) -> int:
    """Attack with each module, print the table; how many faults there were."""
    each = -(-count // len(names))
    print(f"{each} inputs a kind, seed {seed}\n")
    print(f"{'kind':<28}{'inputs':>8}{'refused':>9}{'unharmed':>10}{'faults':>8}{'slowest':>9}")
    faults: list[list[str]] = []
    total = 0
    with tempfile.TemporaryDirectory() as folder:
        for kind in names:
            report = Path(folder) / f"{kind}.json"
            command = [sys.executable, "-m", "tests.fuzz", "--child", kind, str(report)]
            ended = subprocess.run(
                [*command, "--seed", str(seed), "--count", str(each)],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                check=False,
            )
            told = json.loads(report.read_text()) if report.exists() else {"last": "the start"}
            if ended.returncode != 0 or "Traceback" in ended.stderr:
                told.setdefault("faults", []).append([told["last"], ended.stderr[-300:]])
            inputs = told.get("refused", 0) + told.get("unharmed", 0) + len(told["faults"])
            total += inputs
            print(
                f"{told.get('name', kind):<28}{inputs:>8}{told.get('refused', 0):>9}"
                f"{told.get('unharmed', 0):>10}{len(told['faults']):>8}"
                f"{told.get('slowest_s', 0):>7.2f} s",
                flush=True,
            )
            faults += told["faults"]
    print(f"\n{total} inputs, {len(faults)} faults")
    for name, fault in faults[:50]:
        print(f"  {name}: {fault}")
    return len(faults)


def main() -> None:
    """The command; exit code 1 where there was a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=kinds(), choices=kinds())
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        attack(given.child[0], given.seed, given.count, Path(given.child[1]))
        return
    sys.exit(bool(run(given.only, given.seed, given.count)))


if __name__ == "__main__":
    main()
