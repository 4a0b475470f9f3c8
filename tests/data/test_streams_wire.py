"""Records: what goes in comes out, and damage is found, counted and survived."""

import dataclasses
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.data.streams import message_format as wire
from rgbavatar_ns.errors import UserError
from tests.data.streaming import HEAD, same, subject, tracked

SUBJECT = wire.subject_record(subject())
FRAMES = [wire.frame_record(tracked(i)) for i in range(4)]


def read(data: bytes, chunk: int | None = None) -> tuple[list[wire.Record], int]:
    reader = wire.RecordReader()
    records = []
    for start in range(0, len(data), chunk or len(data) or 1):
        records += list(reader.feed(data[start : start + (chunk or len(data))]))
    reader.close()
    return records, reader.garbage_bytes


@pytest.mark.parametrize("chunk", [1, 7, 100, None])
def test_frames_come_through_bit_for_bit_in_pieces_of_any_size(chunk):
    records, garbage = read(SUBJECT + FRAMES[0] + FRAMES[1] + wire.end_record(), chunk)
    assert [record.kind for record in records] == [1, 2, 2, 3]
    assert garbage == 0
    who = wire.parse_subject(records[0])
    assert who.identity.tolist() == subject().identity.tolist()
    assert (who.width, who.height, who.layout) == (12, 8, HEAD.layout)
    for index in (0, 1):
        assert same(tracked(index), wire.parse_frame(records[1 + index], who, 0.0))


def test_header_is_as_documented():
    magic, version, kind, text, theta, data, _, _ = struct.unpack_from("<4sHHIIIII", FRAMES[0])
    assert (magic, version, kind) == (b"\x93RGA", 1, 2)
    assert theta == 4 * HEAD.layout.size
    assert 28 + text + theta + data == len(FRAMES[0])
    assert FRAMES[0][28 + text + theta :].startswith(b"\x89PNG")


def test_another_head_travels_with_its_subject():
    arrays = dataclasses.replace(HEAD.arrays, name="mine", v_template=HEAD.arrays.v_template * 1.5)
    (record,), _ = read(wire.subject_record(dataclasses.replace(subject(), arrays=arrays)))
    got = wire.parse_subject(record).arrays
    assert got.name == "mine"
    assert np.array_equal(got.v_template, arrays.v_template)
    assert np.array_equal(got.shapedirs, arrays.shapedirs)
    assert got.expression_names == arrays.expression_names
    assert got.num_identity == arrays.num_identity


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=200), st.binary(max_size=200), st.integers(1, 500))
def test_garbage_between_records_is_counted_and_costs_no_record(before, between, chunk):
    data = before + FRAMES[0] + between + FRAMES[1]
    records, garbage = read(data, chunk)
    assert [record.fields["index"] for record in records] == [0, 1]
    assert garbage == len(before) + len(between)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, len(FRAMES[1]) - 1), st.integers(1, 255))
def test_a_damaged_byte_costs_its_record_only(place, flip):
    damaged = bytearray(FRAMES[1])
    damaged[place] ^= flip
    records, garbage = read(FRAMES[0] + bytes(damaged) + FRAMES[2], 333)
    assert [record.fields["index"] for record in records] == [0, 2]
    assert garbage == len(damaged)


@pytest.mark.parametrize("cut", [1, 27, 28, 200])
def test_a_record_cut_short_is_no_record(cut):
    records, garbage = read(FRAMES[0] + FRAMES[1][:cut])
    assert len(records) == 1
    assert garbage == cut


def test_a_record_that_claims_to_be_too_large_is_not_waited_for():
    head = struct.pack("<4sHHIIII", wire.MAGIC, 1, 2, 10, 10, wire.LARGEST_DATA + 1, 0)
    huge = head + struct.pack("<I", zlib.crc32(head))
    records, garbage = read(huge + FRAMES[0])
    assert len(records) == 1
    assert garbage == len(huge)


def test_another_version_is_refused_by_name():
    head = struct.pack("<4sHHIIII", wire.MAGIC, 2, 2, 0, 0, 0, 0)
    other = head + struct.pack("<I", zlib.crc32(head))
    with pytest.raises(UserError, match="version 2"):
        read(other)


@pytest.mark.parametrize(
    "fields",
    [{}, {"index": -1}, {"index": True}, {"index": "3"}, {"index": 1 << 70}, {"index": 1.5}],
)
def test_a_frame_without_a_whole_number_is_refused(fields):
    (record,), _ = read(FRAMES[0])
    broken = dataclasses.replace(record, fields={**record.fields, **fields})
    if not fields:
        broken.fields.pop("index")
    with pytest.raises(UserError, match="incomplete"):
        wire.parse_frame(broken, subject(), 0.0)


def test_a_frame_without_a_camera_is_refused():
    (record,), _ = read(FRAMES[0])
    with pytest.raises(UserError, match="streamed frame 0"):
        wire.parse_frame(dataclasses.replace(record, fields={"index": 0}), subject(), 0.0)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"identity": [1.0]}, "identity"),
        ({"identity": [float("nan")] * HEAD.num_identity}, "identity"),
        ({"identity": "me"}, "incomplete"),
        ({"width": 0}, "0 x 8"),
        ({"width": -3}, "incomplete"),
        ({"layout": []}, "theta of 0"),
        ({"layout": 5}, "layout"),
        ({"head": "flame"}, "not known here"),
    ],
)
def test_an_unfit_subject_is_refused_with_the_reason(fields, told):
    (record,), _ = read(SUBJECT)
    with pytest.raises(UserError, match=told):
        wire.parse_subject(dataclasses.replace(record, fields={**record.fields, **fields}))


@pytest.mark.parametrize("packed", [b"no zip", b"PK\x03\x04" + bytes(50)])
def test_a_head_that_cannot_be_read_is_refused(packed):
    (record,), _ = read(SUBJECT)
    with pytest.raises(UserError, match="cannot be read"):
        wire.parse_subject(dataclasses.replace(record, data=packed))
