"""A take of ARKit curves in a CSV file, as Live Link Face and many senders export it."""

import contextlib
import csv
import io
import itertools
import math
import re
import statistics
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.driving.source import PerformanceFrame
from rgbavatar_ns.driving.sources.live_link_face import HEAD_ANGLES, head_rotation
from rgbavatar_ns.driving.sources.paced import RecordedSource
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.head.arkit import ARKIT_NAMES
from rgbavatar_ns.reading import DamagedFileError, read_file

_FRAMES_PER_SECOND = 60.0
"""Of Live Link Face."""
_USUAL_RATES = (24.0, 25.0, 30.0, 48.0, 50.0, 60.0)
_NEAR_A_RATE = 0.1
"""How far from a usual rate counted rows may be, as a share of it: some are lost or come twice."""
_DAY_S = 24 * 3600
_MOST_BYTES = 1 << 28
"""An hour at 60 frames a second has 150 MB."""
_TIMECODE = re.compile(r"(\d{1,3}):(\d{1,2}):(\d{1,2}):(\d{1,3})(?:[.,](\d+))?")
_SEPARATORS = ",;\t"
"""The first is usual; spreadsheets write the second where decimals have a comma."""
_TOLD_SEPARATOR = re.compile(r"\s*sep=([,;\t])\r?\n")
_DECIMAL = re.compile(r"\s*[-+]?\d*\.\d")
_Code = tuple[int, float]
"""A timecode's seconds and frames."""
_REMEDY = (
    "Give the CSV file of a take of Live Link Face: a row of names (EyeBlinkLeft, JawOpen, ...), "
    "then a row of numbers for each frame."
)


def csv_source(
    path: Path,
    frames_per_second: float | None,
    real_time: bool,
    angle_gain: Sequence[float] = (1.0, 1.0, 1.0),
) -> RecordedSource:
    """The rows of a CSV file; columns are known by their names, in any order and case.

    Commas, semicolons or tabs separate them; decimals have a point or a comma.

    Timecodes (hours:minutes:seconds:frames, of a take with so many `frames_per_second`; by default
    as many as they count to) tell the time; where they are missing or stand still, each row is the
    next frame, of so many a second as the timecodes have rows, else of 60. Rows without numbers,
    as the app leaves where it lost the face, are passed over. angle_gain: of yaw, pitch and roll.
    Raises UserError where the file cannot be read or has no such column.
    """
    names, rows = _read(path)
    columns = {name.strip().lower(): place for place, name in enumerate(names)}
    places = [columns.get(name.lower()) for name in ARKIT_NAMES]
    if all(place is None for place in places):
        raise UserError(f"{path} has no ARKit columns: {first_few(names, 4)}.", _REMEDY)
    _require_decimal_points(path, names, rows)
    angles = [columns.get(name.lower()) for name in HEAD_ANGLES]
    frames = _timed(names, rows, places, frames_per_second)
    if not frames:
        raise UserError(f"{path} has no row of numbers.", _REMEDY)

    turned = [place for place in angles if place is not None]
    turns = _turns(frames, turned, angle_gain) if len(turned) == len(angles) else None

    def frame(place: int, captured_s: float) -> PerformanceFrame:
        values, time_s = frames[place]
        turn = None if turns is None else turns[place]
        return PerformanceFrame(
            place,
            captured_s,
            time_s,
            coefficients=_coefficients(values, places),
            head_rotation=turn,
        )

    source = RecordedSource([time_s for _, time_s in frames], frame, None, real_time)
    source.counts["rows without numbers"] = len(rows) - len(frames)
    return source


def _read(path: Path) -> tuple[list[str], list[list[str]]]:
    try:
        text = read_file(path, _MOST_BYTES).decode("utf-8-sig")
        told = _TOLD_SEPARATOR.match(text)  # as Excel writes and reads it
        separator = told[1] if told else _separator(text)
        lines = csv.reader(io.StringIO(text[told.end() :] if told else text), delimiter=separator)
        table = [row for row in lines if any(map(str.strip, row))]
    except (DamagedFileError, UnicodeDecodeError, csv.Error, OSError) as error:
        raise UserError(f"{path} cannot be read as CSV: {error}.", _REMEDY) from None
    if len(table) < 2:
        raise UserError(f"{path} holds no rows.", _REMEDY)
    return table[0], table[1:]


def _require_decimal_points(path: Path, names: list[str], rows: list[list[str]]) -> None:
    """UserError where commas separate columns and decimals alike: a number is two values then."""
    longer = sum(any(map(str.strip, row[len(names) :])) for row in rows)
    pointed = any(_DECIMAL.match(value) for row in rows for value in row)
    if longer > len(rows) / 2 and not pointed:
        raise UserError(
            f"{path} has {len(names)} names and more values in {longer} of {len(rows)} rows: "
            "commas separate its columns and its decimals alike.",
            "Write decimals with a point, or separate the columns by semicolons.",
        )


def _separator(text: str) -> str:
    """What separates the most of ARKit's names in the first line that is not blank."""
    first = next((line for line in io.StringIO(text) if line.strip()), "")
    known = {name.lower() for name in ARKIT_NAMES}

    def found(separator: str) -> int:
        names = next(csv.reader([first], delimiter=separator), [])
        return sum(name.strip().lower() in known for name in names)

    return max(_SEPARATORS, key=found)


def _timed(
    names: list[str],
    rows: list[list[str]],
    places: Sequence[int | None],
    frames_per_second: float | None,
) -> list[tuple[list[float], float]]:
    """Each row's numbers (NaN where there is none) and its time.

    Rows without a number in one of `places`, ARKit's columns, are left out.
    """
    moments = _moments_s(names, rows, frames_per_second)
    found: list[tuple[list[float], float]] = []
    for row, moment_s in zip(rows, moments):
        values = [_number(text) for text in row] + [math.nan] * (len(names) - len(row))
        if any(math.isfinite(values[at]) for at in places if at is not None):
            found.append((values, moment_s))
    return found


def _moments_s(
    names: list[str], rows: list[list[str]], frames_per_second: float | None
) -> list[float]:
    """The time of each row by its timecode; by its place where one is missing or does not rise."""
    clock = next((k for k, name in enumerate(names) if name.strip().lower() == "timecode"), None)
    texts = ["" if clock is None or len(row) <= clock else row[clock] for row in rows]
    codes = _over_midnight([_timecode(text) for text in texts])
    told = [code for code in codes if code is not None]
    if len(told) == len(rows):
        rate = frames_per_second or _rate_of(told) or _FRAMES_PER_SECOND
        moments = [seconds + frames / rate for seconds, frames in told]
        if all(earlier < later for earlier, later in itertools.pairwise(moments)):
            return [moment - moments[0] for moment in moments]
    rate = frames_per_second or _rows_a_second(codes) or _FRAMES_PER_SECOND
    return [place / rate for place in range(len(rows))]


def _timecode(text: str) -> _Code | None:
    """Seconds and frames of hours:minutes:seconds:frames.part; None for anything else."""
    read = _TIMECODE.fullmatch(text.strip())
    if read is None:
        return None
    hours, minutes, seconds, frames = (int(part) for part in read.groups()[:4])
    part = float(f"0.{read[5]}") if read[5] else 0.0
    return 3600 * hours + 60 * minutes + seconds, frames + part


def _over_midnight(codes: list[_Code | None]) -> list[_Code | None]:
    """The codes with seconds that go on where the day's begin again."""
    days, last_s, result = 0, 0, list[_Code | None]()
    for code in codes:
        if code is not None:
            days += last_s - code[0] > _DAY_S / 2
            last_s, code = code[0], (code[0] + days * _DAY_S, code[1])
        result.append(code)
    return result


def _rows_a_second(codes: list[_Code | None]) -> float | None:
    """The usual rate nearest to the rows of most seconds told; None without one near.

    Codes may count to another number: a take of 60 rows a second has each of 30 twice.
    """
    begins: list[tuple[int, int]] = []
    before = None
    for place, code in enumerate(codes):
        if code is not None:
            if before is not None and code[0] != before:
                begins.append((place, code[0]))
            before = code[0]
    whole = [b[0] - a[0] for a, b in itertools.pairwise(begins) if b[1] - a[1] == 1]
    if not whole:
        return None
    counted = statistics.median_high(whole)  # a clock that jumps cuts some seconds short
    nearest = min(_USUAL_RATES, key=lambda rate: abs(rate - counted))
    return nearest if abs(nearest - counted) <= _NEAR_A_RATE * nearest else None


def _rate_of(codes: list[_Code]) -> float | None:
    """Frames a second that timecodes count to, one of the usual; None where they do not show it.

    They do where a second ends: its last frame has the greatest number, which may be missing once.
    """
    if codes[0][0] == codes[-1][0]:
        return None
    count = 1 + int(max(frames for _, frames in codes))
    rate = next((rate for rate in _USUAL_RATES if rate >= count), None)
    return None if rate is None or rate - count > 1 else rate


def _turns(
    frames: list[tuple[list[float], float]], places: Sequence[int], gain: Sequence[float]
) -> list[Float[Tensor, "3"]]:
    """The head's turn of each row; where a row tells none, it stays."""
    told, turns = [0.0, 0.0, 0.0], []
    for values, _ in frames:
        new = [values[place] * factor for place, factor in zip(places, gain)]
        told = new if all(map(math.isfinite, new)) else told
        turns.append(head_rotation(*told))
    return turns


def _number(text: str) -> float:
    for told in (text, text.replace(",", ".")):
        with contextlib.suppress(ValueError):
            return float(told)
    return math.nan


def _coefficients(values: list[float], places: Sequence[int | None]) -> Float[Tensor, "52"]:
    told = [math.nan if place is None else values[place] for place in places]
    return torch.tensor([value if math.isfinite(value) else 0.0 for value in told])
