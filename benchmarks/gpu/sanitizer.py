"""compute-sanitizer over small cases: wrong addresses, races, barriers, what was never written."""

import re
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial

from benchmarks.gpu.rows import Figures, Rows, check
from benchmarks.gpu.small_case import DONE
from benchmarks.gpu.tools import CASES_SECONDS, Ran, required_tool, run_case
from rgbavatar_ns.kernels.cuda.source import kernels

NAME = "compute-sanitizer"
_OPTIONS = ("--print-limit", "50", "--show-backtrace", "no")
# Libraries try calls that a driver need not know.
_ONLY_KERNELS = ("--report-api-errors", "no")
# Each tensor is an allocation of its own, so that what lies beside it belongs to nobody.
_APART = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
_MARK = re.compile(r"^={9} ?(.*)$", re.MULTILINE)
_SUMMARY = re.compile(r"^={9} (?:ERROR|RACECHECK) SUMMARY: (\d+)", re.MULTILINE)
_NUMBERS = re.compile(r"0x[0-9a-f]+|\(\d+,\d+,\d+\)")
_WORDS_OF_ITS_OWN = (
    "COMPUTE-SANITIZER",
    "ERROR SUMMARY",
    "RACECHECK SUMMARY",
    "Target application",
)
_MOST = 20


def _asked(kind: str, cases: Sequence[str], rows: Rows) -> None:
    """A row for each case under the tool."""
    end = time.monotonic() + CASES_SECONDS
    for case in cases:
        with rows.row(case) as figures:
            program = required_tool(NAME)
            apart = kind in ("memcheck", "initcheck") and case == "fused"
            options = ["--tool", kind, *_OPTIONS, *(_ONLY_KERNELS if kind == "memcheck" else ())]
            environment, left_s = _APART if apart else {}, end - time.monotonic()
            ran = run_case([program, *options], case, environment, left_s)
            figures |= judged(ran)


memcheck = partial(_asked, "memcheck", ("fused", "recorded"))
racecheck = partial(_asked, "racecheck", ("fused",))
synccheck = partial(_asked, "synccheck", ("fused",))
initcheck = partial(_asked, "initcheck", ("fused",))


def judged(ran: Ran) -> Figures:
    """What the tool found; it fails by what is in our kernels, and where it has not seen all."""
    summary, found = _SUMMARY.search(ran.text), findings(ran.text)
    names = [f"{name}_kernel" for name in kernels()]
    own = {text: n for text, n in found.items() if any(name in text for name in names)}
    others = {text: n for text, n in found.items() if text not in own}
    figures: Figures = {
        "seconds": ran.seconds,
        "errors": None if summary is None else int(summary[1]),
        "in_our_kernels": own,
        "in_others": others,
    }
    check(figures, not own, "it found something in our kernels")
    whole = ran.ended and DONE in ran.text and summary is not None
    check(figures, whole, "it did not get through the case")
    told = summary is None or int(summary[1]) == 0 or bool(found)
    check(figures, told, "it counts errors that it does not show")
    if "failed" in figures:
        figures["says"] = ran.text[-2000:]
    return figures


def findings(text: str) -> dict[str, int]:
    """What its marked lines report, with where, and how often; addresses and threads left out."""
    counts: Counter[str] = Counter()
    first: str | None = None
    for line in _MARK.findall(text):
        if line.startswith(" "):
            place = line.strip()
            if first is not None and place.startswith(("at ", "and ", "in ")):
                counts[_NUMBERS.sub("...", f"{first} {place}")] += 1
                first = None
            continue
        if first is not None:  # the one before gave no place
            counts[_NUMBERS.sub("...", first)] += 1
        words = line.strip()
        first = words if words and not words.startswith(_WORDS_OF_ITS_OWN) else None
    return dict(counts.most_common(_MOST))
