"""Files of others: every fault is a DamagedFileError, soon, and what is whole comes out whole."""

import io
import json
import os
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.head.arrays import embedded_file
from rgbavatar_ns.reading import (
    DamagedFileError,
    MissingFileError,
    json_numbers,
    load_arrays,
    load_json,
    parse_array,
    parse_json,
    read_file,
)


def _npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def test_files_that_are_no_files_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    for path in (tmp_path / "fifo", tmp_path, tmp_path / ("n" * 5000), tmp_path / "a\0b"):
        with pytest.raises(DamagedFileError):
            read_file(path, 100)
    with pytest.raises(MissingFileError):
        read_file(tmp_path / "none", 100)
    (tmp_path / "long").write_bytes(b"0" * 101)
    with pytest.raises(DamagedFileError, match="longer than 100 bytes"):
        read_file(tmp_path / "long", 100)


@pytest.mark.parametrize(
    "text",
    [b"[" * 100_000, b"[" * 70 + b"]" * 70, b"1" * 5000, b'{"a": 1' + b"0" * 400 + b"}", b"\xff",
     b'{"a": "\\ud800"}', b"{", b""],
)  # fmt: skip
def test_json_that_would_break_its_readers_is_refused(text):
    with pytest.raises(DamagedFileError):
        parse_json(text)


def test_json_that_is_whole_is_read_as_json_reads_it(tmp_path):
    value = {"a": [1, -2.5, None, True, "\U0001f600"], "b": {"deep": [[[[]]]]}}
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(value).encode())
    assert load_json(tmp_path / "a.json") == value


@pytest.mark.parametrize(
    "value", [[True, 1], [1e400, 1], ["1", 2], [float("nan"), 1], [1], [[1, 2]], None, {"0": 1}]
)
def test_only_finite_numbers_of_the_shape_count_as_numbers(value):
    with pytest.raises(DamagedFileError):
        json_numbers(value, (2,))
    assert json_numbers([[1, 2.5]], (1, 2)).tolist() == [[1, 2.5]]


def test_the_embedded_head_is_read_as_numpy_reads_it():
    ours = load_arrays(embedded_file())
    with np.load(embedded_file()) as theirs:
        assert set(ours) == set(theirs.files)
        for name, array in ours.items():
            np.testing.assert_array_equal(array, theirs[name])
            assert array.dtype == theirs[name].dtype


@given(
    flips=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 7)), min_size=1, max_size=8),
    cut=st.integers(0, 400),
)
@settings(max_examples=300, deadline=None)
def test_turned_bits_of_an_npz_are_told_or_change_nothing(tmp_path_factory, flips, cut):
    arrays = {"numbers": np.arange(60.0), "names": np.array(["a", "bcd"])}
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    content = bytearray(file.getvalue())
    for place, bit in flips:
        content[place % len(content)] ^= 1 << bit
    path = tmp_path_factory.getbasetemp() / "turned.npz"
    path.write_bytes(content[: len(content) - cut] if cut % 3 == 0 else content)
    try:
        read = load_arrays(path)
    except DamagedFileError:
        return
    for name in read.keys() & arrays.keys():
        np.testing.assert_array_equal(read[name], arrays[name])


def _header(text):
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    "content",
    [
        _header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}\n"),
        _header(b"{'descr': 'S0', 'fortran_order': False, 'shape': (1000000000000,)}\n"),
        _header(b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\n") + b"0" * 8,
        _header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}\n"),
        _header(b"{'descr': '<f8', 'fortran_order': False, 'shape': (True,)}\n") + b"0" * 8,
        _header(b"(" * 9000),
        b"PK\x03\x04",
        b"",
        _npy(np.arange(5.0))[:-1],
        _npy(np.arange(5.0)) + b"0",
    ],
)
def test_arrays_that_are_none_or_claim_more_than_there_is_are_refused(content):
    with pytest.raises(DamagedFileError):
        parse_array(content)


@given(st.binary(max_size=300), st.booleans())
@settings(max_examples=300, deadline=None)
def test_no_bytes_make_an_array_reader_raise_anything_else(junk, headed):
    with pytest.raises(DamagedFileError):
        parse_array(_npy(np.zeros(0))[:10] + junk if headed else junk)


@pytest.mark.parametrize("packing", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_unusual_packing_is_refused(tmp_path, packing):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", packing) as archive:
        archive.writestr("x.npy", _npy(np.zeros(3)))
    with pytest.raises(DamagedFileError, match="unusual"):
        load_arrays(tmp_path / "a.npz")


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", _npy(np.zeros(20_000_000)))
    with pytest.raises(DamagedFileError, match="claim"):
        load_arrays(tmp_path / "a.npz")
