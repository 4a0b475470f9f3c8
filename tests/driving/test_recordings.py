"""CSV takes and datasets as performances."""

import json
import math

import pytest
import torch

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.driving.source import PerformanceFrame
from rgbavatar_ns.driving.sources.arkit_csv import csv_source
from rgbavatar_ns.driving.sources.dataset import dataset_source
from rgbavatar_ns.driving.sources.paced import RecordedSource
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arkit import ARKIT_NAMES
from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset
from tests.plugin.tiny import tiny_dataset


class _Clock:
    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s

    def sleep(self, seconds):
        self.now_s += seconds


def _recorded(clock, real_time=True, count=10):
    def frame(place, captured_s):
        return PerformanceFrame(place, captured_s, place / 25)

    times_s = [place / 25 for place in range(count)]
    return RecordedSource(times_s, frame, None, real_time, clock, clock.sleep)


def test_a_recording_plays_at_its_own_speed():
    clock = _Clock()
    source = _recorded(clock)
    at = []
    while not source.ended:
        frame = source.next(1.0)
        at.append(round(clock.now_s - 100.0, 6))
        assert frame.captured_s == pytest.approx(clock.now_s)
    assert at == [round(k / 25, 6) for k in range(10)]
    assert source.counts["skipped"] == 0


def test_who_is_slow_gets_the_newest_frame_and_how_late_it_is():
    clock = _Clock()
    source = _recorded(clock)
    source.next(1.0)
    clock.now_s += 0.21
    frame = source.next(1.0)
    assert frame.index == 5
    assert clock.now_s - frame.captured_s == pytest.approx(0.01)
    assert source.counts["skipped"] == 4


def test_without_a_clock_every_frame_is_given():
    clock = _Clock()
    source = _recorded(clock, real_time=False)
    indices = []
    while not source.ended:
        clock.now_s += 1.0
        indices.append(source.next(0.0).index)
    assert indices == list(range(10))


def _take(tmp_path, header, rows):
    path = tmp_path / "take.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_columns_are_known_by_name_in_any_order_and_case(tmp_path):
    header = "Timecode,BlendShapeCount,JawOpen,eyeBlinkLeft,HeadYaw,HeadPitch,HeadRoll"
    rows = ["00:00:00:01.000,61,0.25,0.5,0.1,0,0", "00:00:00:02.000,61,0.75,1.0,0.2,0,0"]
    source = csv_source(_take(tmp_path, header, rows), 60.0, False)
    frames = [source.next(0.0), source.next(0.0)]
    assert source.ended
    jaw, blink = ARKIT_NAMES.index("jawOpen"), ARKIT_NAMES.index("eyeBlinkLeft")
    assert [float(f.coefficients[jaw]) for f in frames] == [0.25, 0.75]
    assert [float(f.coefficients[blink]) for f in frames] == [0.5, 1.0]
    assert frames[1].head_rotation[1] == pytest.approx(-0.2, abs=1e-6)
    assert frames[1].time_s == pytest.approx(1 / 60)


def test_mirrored_and_degree_senders_are_put_right(tmp_path):
    header = "jawOpen,HeadYaw,HeadPitch,HeadRoll"
    gain = (-math.pi / 180, 1.0, 1.0)
    source = csv_source(_take(tmp_path, header, ["0.1,30,0,0"]), 60.0, False, gain)
    assert source.next(0.0).head_rotation[1] == pytest.approx(math.pi / 6, abs=1e-5)


def test_where_a_row_tells_no_turn_the_head_stays(tmp_path):
    rows = ["0.1,,,", "0.2,0.3,0,0", "0.3,,0,0", "0.4,inf,0,0", "0.5,0.1,0,0"]
    take = _take(tmp_path, "jawOpen,HeadYaw,HeadPitch,HeadRoll", ["0.1,0,0,0", *rows])
    source = csv_source(take, 60.0, False)
    turns = []
    while not source.ended:
        turns.append(source.next(0.0).head_rotation)
    yaws = [-float(turn[1]) for turn in turns]
    assert yaws == pytest.approx([0.0, 0.0, 0.3, 0.3, 0.3, 0.1], abs=1e-6)


def test_rows_without_numbers_are_passed_over_in_their_time(tmp_path):
    rows = ["00:00:00:01.000,61,0.1", "00:00:00:02.000,0,", "00:00:00:03.000,61,0.3"]
    source = csv_source(_take(tmp_path, "Timecode,BlendShapeCount,JawOpen", rows), 60.0, False)
    frames = [source.next(0.0), source.next(0.0)]
    assert source.ended
    assert source.counts["rows without numbers"] == 1
    assert frames[1].time_s == pytest.approx(2 / 60)


@pytest.mark.parametrize(
    ("codes", "seconds"),
    [
        (["10:00:00:58.000", "10:00:00:59.500", "10:00:01:06.000"], [0, 1.5 / 60, 8 / 60]),
        (["10:00:00:58", "10:00:00:59", "10:00:01:00"], [0, 1 / 60, 2 / 60]),
        (["10:00:00:58", "10:00:00:58", "10:00:01:00"], [0, 1 / 60, 2 / 60]),  # it stands
        (["later", "", "10:00:01:00"], [0, 1 / 60, 2 / 60]),
    ],
)
def test_timecodes_tell_the_time_where_they_can(tmp_path, codes, seconds):
    rows = [f"{code},61,0.{k}" for k, code in enumerate(codes, 1)]
    source = csv_source(_take(tmp_path, "Timecode,BlendShapeCount,JawOpen", rows), 60.0, False)
    times_s = [source.next(0.0).time_s for _ in rows]
    assert times_s == pytest.approx(seconds, abs=1e-6)


def _codes(rate: int, count: int, first: int) -> list[str]:
    return [f"10:00:{k // rate:02}:{k % rate:02}.000" for k in range(first, first + count)]


@pytest.mark.parametrize("rate", [24, 25, 30, 48, 50, 60])
@pytest.mark.parametrize("first", [0, 20])
def test_timecodes_tell_how_many_frames_a_second_has(tmp_path, rate, first):
    rows = [f"{code},0.5" for code in _codes(rate, 2 * rate, first)]
    source = csv_source(_take(tmp_path, "Timecode,JawOpen", rows), None, False)
    times_s = [source.next(0.0).time_s for _ in rows]
    assert times_s == pytest.approx([k / rate for k in range(2 * rate)], abs=1e-6)


def _spoilt(codes: list[str], how: str) -> list[str]:
    codes = list(codes)
    if how == "one comes twice":
        codes[40] = codes[39]
    elif how == "one is missing":
        codes[40] = ""
    elif how == "one a second is missing":
        codes[::30] = [""] * len(codes[::30])
    elif how == "it goes back":
        codes[70] = codes[10]
    elif how == "the take was paused":
        codes[60:] = [code.replace("10:00", "14:00") for code in codes[60:]]
        codes[40] = codes[39]
    return codes


@pytest.mark.parametrize("rate", [24, 25, 30, 60])
@pytest.mark.parametrize(
    "how",
    ["one comes twice", "one is missing", "one a second is missing", "it goes back",
     "the take was paused"],
)  # fmt: skip
def test_spoilt_timecodes_still_tell_how_many_frames_a_second_has(tmp_path, rate, how):
    codes = _spoilt(_codes(rate, 4 * rate, 7), how)
    source = csv_source(
        _take(tmp_path, "Timecode,JawOpen", [f"{code},0.5" for code in codes]), None, False
    )
    times_s = [source.next(0.0).time_s for _ in codes]
    assert times_s == pytest.approx([k / rate for k in range(4 * rate)], abs=1e-6)


def test_sixty_rows_a_second_whose_timecodes_count_to_thirty_stay_sixty(tmp_path):
    rows = [f"{code},0.5" for code in _codes(30, 90, 5) for _ in range(2)]
    source = csv_source(_take(tmp_path, "Timecode,JawOpen", rows), None, False)
    times_s = [source.next(0.0).time_s for _ in rows]
    assert times_s == pytest.approx([k / 60 for k in range(180)], abs=1e-6)


@pytest.mark.parametrize("rate", [25, 60])
def test_a_take_that_passes_midnight_goes_on(tmp_path, rate):
    codes = [
        f"{k // 3600 % 24:02}:{k // 60 % 60:02}:{k % 60:02}:{frame:02}"
        for k in range(24 * 3600 - 2, 24 * 3600 + 2)
        for frame in range(rate)
        if frame != 3  # a gap, which only timecodes tell
    ]
    source = csv_source(
        _take(tmp_path, "Timecode,JawOpen", [f"{code},0.5" for code in codes]), None, False
    )
    times_s = [source.next(0.0).time_s for _ in codes]
    wanted = [k / rate for k in range(4 * rate) if k % rate != 3]
    assert times_s == pytest.approx(wanted, abs=1e-6)


def test_what_is_asked_for_or_usual_holds_where_timecodes_show_no_rate(tmp_path):
    def last_s(codes: list[str], rate: float | None) -> float:
        rows = [f"{code},0.5" for code in codes]
        source = csv_source(_take(tmp_path, "Timecode,JawOpen", rows), rate, False)
        return [source.next(0.0).time_s for _ in rows][-1]

    assert last_s(_codes(30, 10, 0), None) == pytest.approx(9 / 60)  # no second ends
    assert last_s(_codes(30, 10, 0), 30.0) == pytest.approx(9 / 30)
    assert last_s(["10:00:00:10", "10:00:01:10"], None) == pytest.approx(1.0)


@pytest.mark.parametrize("first", ["", "sep={}\r\n"])
@pytest.mark.parametrize(
    ("separator", "decimal"), [(";", ","), (";", "."), ("\t", ","), ("\t", ".")]
)
def test_a_spreadsheets_take_is_read_as_the_phones(tmp_path, separator, decimal, first):
    header = "Timecode,BlendShapeCount,JawOpen,EyeBlinkLeft,HeadYaw,HeadPitch,HeadRoll"
    codes = _codes(30, 90, 5)
    rows = [f"{code},61,0.{k:02},{k % 2},-0.{k:02},1e-3,0" for k, code in enumerate(codes)]
    plain = csv_source(_take(tmp_path, header, rows), None, False)
    written = [line.replace(",", separator).replace(".", decimal) for line in (header, *rows)]
    path = tmp_path / "europe.csv"
    told = first.format(separator)
    path.write_bytes((told + "\r\n".join(written) + "\r\n").encode("utf-8-sig"))
    europe = csv_source(path, None, False)
    for _ in rows:
        one, other = plain.next(0.0), europe.next(0.0)
        assert torch.equal(one.coefficients, other.coefficients)
        assert torch.equal(one.head_rotation, other.head_rotation)
        assert one.time_s == other.time_s
    assert plain.ended
    assert europe.ended


def test_quoted_decimal_commas_are_read_and_bare_ones_between_commas_told(tmp_path):
    source = csv_source(_take(tmp_path, "JawOpen,MouthClose", ['"0,25",0']), None, False)
    assert source.next(0.0).coefficients[ARKIT_NAMES.index("jawOpen")] == 0.25
    rows = ["0,25,0", "0,5,0,1", "0,0"]
    with pytest.raises(UserError, match=r"2 names and more values in 2 of 3 rows: commas") as told:
        csv_source(_take(tmp_path, "JawOpen,MouthClose", rows), None, False)
    assert "semicolons" in told.value.remedy
    for more in (",,", ",0.75", ",7"):
        rows = ["0.25,0" + more, "0.5,0" + more]
        longer = csv_source(_take(tmp_path, "JawOpen,MouthClose", rows), None, False)
        assert longer.next(0.0).coefficients[ARKIT_NAMES.index("jawOpen")] == 0.25


def test_blank_rows_are_none(tmp_path):
    rows = ["10:00:00:00,0.1", "", "10:00:00:30,0.2", " ", ""]
    source = csv_source(_take(tmp_path, "Timecode,JawOpen", rows), 60.0, False)
    assert [source.next(0.0).time_s for _ in range(2)] == pytest.approx([0.0, 0.5])
    assert source.ended
    assert source.counts["rows without numbers"] == 0


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("a,b\n1,2\n", "has no ARKit columns: a, b"),
        ("a take\njawOpen,mouthClose\n1,2\n", "has no ARKit columns: a take"),
        ("jawOpen\n", "holds no rows"),
        ("jawOpen,mouthClose\nx,y\n", "no row of numbers"),
        ("", "holds no rows"),
    ],
)
def test_other_files_are_told(tmp_path, content, told):
    path = tmp_path / "take.csv"
    path.write_text(content)
    with pytest.raises(UserError, match=told):
        csv_source(path, 60.0, False)


def test_a_missing_or_binary_file_is_told(tmp_path):
    with pytest.raises(UserError, match="cannot be read as CSV"):
        csv_source(tmp_path / "none.csv", 60.0, False)
    (tmp_path / "b.csv").write_bytes(bytes(range(256)))
    with pytest.raises(UserError, match="cannot be read as CSV"):
        csv_source(tmp_path / "b.csv", 60.0, False)


def test_a_dataset_performs_with_its_own_theta_and_pictures(tmp_path):
    config = DemoConfig(num_frames=6, num_test_frames=2, image_size=32)
    make_demo_dataset(tmp_path / "data", config)
    made = load_dataset(tmp_path / "data")
    source = dataset_source(made.root, None, False, 16)
    frames = []
    while not source.ended:
        frames.append(source.next(0.0))
    assert torch.equal(torch.stack([f.theta for f in frames]), made.theta)
    assert frames[0].image_rgb.shape == (16, 16, 3)
    assert source.head.layout == made.layout
    assert [f.time_s for f in frames] == pytest.approx(
        [k / config.frames_per_second for k in range(6)]
    )
    faster = dataset_source(made.root, 50.0, False, None)
    assert [faster.next(0.0).time_s for _ in range(6)] == pytest.approx([k / 50 for k in range(6)])


def test_frames_that_are_not_in_a_dataset_leave_a_gap_in_its_performance(tmp_path):
    made = tiny_dataset(tmp_path / "data", frames=5, test=1)
    path = tmp_path / "data" / "dataset.json"
    written = json.loads(path.read_text())

    def times_s(**columns: list[object]) -> list[tuple[int, float]]:
        frames = [dict(frame) for frame in written["frames"]]
        for name, values in columns.items():
            for frame, value in zip(frames, values):
                frame[name] = value
        held_out = {"test": [frames[-1]["index"]]}
        path.write_text(json.dumps({**written, "frames": frames} | held_out))
        source, found = dataset_source(made.root, 10.0, False, None), []
        while not source.ended:
            frame = source.next(0.0)
            place = int((made.theta - frame.theta).abs().sum(1).argmin())
            found.append((place, round(frame.time_s, 6)))
        return found

    # Two faces were not found, and the list need not follow the film.
    assert times_s(index=[12, 10, 15, 16, 11]) == [(1, 0), (4, 0.1), (0, 0.2), (2, 0.5), (3, 0.6)]
    cameras = {"index": [0, 1, 2, 4, 5], "camera_name": list("abaab")}
    steps = {"timestep": [7, 7, 8, 10, 11]}
    assert times_s(**cameras, **steps) == [(0, 0), (2, 0.1), (3, 0.3)]
    assert times_s(**cameras) == [(0, 0), (2, 0.1), (3, 0.2)]
