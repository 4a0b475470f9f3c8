"""Pickles of others: what Python itself would give, or an error; never a call of theirs."""

import codecs
import contextlib
import os
import pickle
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.safe_pickle import MAX_OPCODES, read_pickle

_MB = 2**20


@pytest.fixture
def write(tmp_path: Path):
    def write(data: bytes) -> Path:
        path = tmp_path / "file.pkl"
        path.write_bytes(data)
        return path

    return write


def same(a, b) -> bool:
    if scipy.sparse.issparse(a):
        return bool((a.toarray() == b.toarray()).all()) and a.dtype == b.dtype
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


VALUES = {
    "floats": np.arange(12.0).reshape(3, 4),
    "columns first": np.asfortranarray(np.arange(12, dtype=np.uint32).reshape(3, 4)),
    "big endian": np.arange(3, dtype=">i4"),
    "no dimension": np.array(3.0),
    "empty": np.zeros((0, 3)),
    "texts": np.array(["ab", "c"]),
    "scalar": np.float32(3.5),
    "csc": scipy.sparse.csc_matrix(np.eye(4)),
    "csr": scipy.sparse.csr_array(np.eye(4)),
    "plain": (1, 2.5, None, True, False, "xyä", b"ab\xff", -3, 2**40, [1, [3]], {}),
}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_values_come_back_as_python_reads_them(write, protocol):
    assert same(VALUES, read_pickle(write(pickle.dumps(VALUES, protocol))))


_PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats(allow_nan=False)
    | st.text()
    | st.binary()
    | arrays.arrays(
        arrays.integer_dtypes() | arrays.floating_dtypes(sizes=(32, 64)),
        arrays.array_shapes(min_side=0),
    ),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner, inner),
    max_leaves=6,
)


@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(_PLAIN, st.integers(0, pickle.HIGHEST_PROTOCOL))
def test_any_plain_value_comes_back(write, value, protocol):
    assert same(value, read_pickle(write(pickle.dumps(value, protocol))))


def test_shared_arrays_stay_shared_and_are_writable(write):
    array = np.zeros(3)
    first, second = read_pickle(write(pickle.dumps([array, array])))
    first[0] = 1
    assert second[0] == 1


def test_a_list_that_contains_itself_is_refused(write):
    loop: list = [np.ones(2)]
    loop.append(loop)
    with pytest.raises(UserError, match="nested too deeply"):
        read_pickle(write(pickle.dumps(loop)))


MADE_ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"
PYTHON_2_ARRAY = (
    MADE_ARRAY + b"(K\x01(K\x02tcnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xff"
    b"J\xff\xff\xff\xffK\x00tb\x89U\x10" + struct.pack("<2d", -1.5, 2.25) + b"tb"
)


def test_python_2_text_is_latin_1_and_holds_array_bytes(write):
    data = b"\x80\x02" + PYTHON_2_ARRAY + b"."
    assert np.array_equal(pickle.loads(data, encoding="latin1"), [-1.5, 2.25])
    assert np.array_equal(read_pickle(write(data)), [-1.5, 2.25])
    assert read_pickle(write(b"S'a\\xe9\\'b'\np0\n.")) == "aé'b"


def _part(value, protocol: int = 2) -> bytes:
    """A value's pickle without its head and its end, to stand inside of another."""
    return pickle.dumps(value, protocol)[2:-1]


def _chumpy(name: bytes, state: bytes) -> bytes:
    return b"ccopy_reg\n_reconstructor\n(" + name + b"c__builtin__\nobject\nNtR}(" + state + b"ub"


CHUMPY_ARRAY = _chumpy(b"cchumpy.ch\nCh\n", b"U\x01x" + PYTHON_2_ARRAY)


def test_chumpy_arrays_are_read_without_chumpy(write):
    assert np.array_equal(read_pickle(write(b"\x80\x02" + CHUMPY_ARRAY + b".")), [-1.5, 2.25])
    state = b"U\x01a" + CHUMPY_ARRAY + b"U\x04idxs" + _part(np.array([1, 1, 0]))
    selected = _chumpy(b"cchumpy.reordering\nSelect\n", state)
    assert np.array_equal(read_pickle(write(b"\x80\x02" + selected + b".")), [2.25, 2.25, -1.5])


def test_a_computed_chumpy_array_is_refused_by_name(write):
    data = b"\x80\x02" + _chumpy(b"cchumpy.ch\nCh\n", b"U\x01bK\x01") + b"."
    with pytest.raises(UserError, match=r"chumpy\.ch\.Ch is computed"):
        read_pickle(write(data))


class Calls:
    """A pickle that calls something when it is read."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


CALLED = []


def tell(text):
    CALLED.append(text)


HOSTILE = {
    "os.system": (Calls(os.system, "false"), r"(posix|nt)\.system"),
    "eval": (Calls(eval, "tell('x')"), r"builtins\.eval|__builtin__\.eval"),
    "exec": (Calls(exec, "tell('x')"), r"exec"),
    "own function": (Calls(tell, "x"), r"test_safe_pickle\.tell"),
    "nested": ({"a": [Calls(np.dtype, [Calls(os.getcwd)])]}, r"getcwd"),
    "list": (Calls(list, [1]), r"list"),
    "getattr": (Calls(getattr, [], "append"), r"getattr"),
    "another class": (Path("x"), r"[Pp]ath"),
    "array of objects": (np.array([{}, None], dtype=object), "are no numbers"),
    "array of records": (np.zeros(2, [("a", "f4")]), "are no numbers|records"),
    "bytearray by number": (Calls(bytearray, 2**40), r"bytearray"),
    "doubled bytes": (Calls(codecs.encode, b"xx", "hex"), "bytes from something"),
    "tuples as keys": ({((1,), 2): 3}, "tuple as a key"),
    "numpy.load": (Calls(np.load, "x.npy"), "numpy.*load"),
}


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_not_on_the_list_is_refused_by_name(write, name, protocol):
    value, told = HOSTILE[name]
    with pytest.raises(UserError, match=told) as refused:
        read_pickle(write(pickle.dumps(value, protocol)))
    assert "Nothing in it was run" in refused.value.remedy
    assert not CALLED


BOMBS = {
    "array header": (
        MADE_ARRAY
        + b"(K\x01(%bt%b\x89C\x08" % (_part(2**40 - 1), _part(np.dtype("f8")))
        + bytes(8)
        + b"tb.",
        "claims an array of",
    ),
    "text length": (b"\x8d" + struct.pack("<Q", 2**62) + b"x.", "damaged"),
    "bytes length": (b"\x8e" + struct.pack("<Q", 2**40) + b"x.", "damaged"),
    "bytearray length": (b"\x96" + struct.pack("<Q", 2**40) + b"x.", "damaged"),
    "negative text length": (b"T\xff\xff\xff\xffx.", "damaged"),
    "long number": (b"\x8b" + struct.pack("<i", 2**30) + b"x.", "damaged"),
    "many digits": (b"L" + b"9" * 10**6 + b"L\n.", "damaged"),
    "memo number": (b"]r\xff\xff\xff\xff0j\xff\xff\xff\xfe.", "remembers more"),
    "deep nesting": (b"]" * 5_000 + b"a" * 4_999 + b".", "nested too deeply"),
    "endless hash": (b")" + b"q\x000h\x00h\x00\x86" * 60 + b"q\x000}h\x00Ns.", "tuple as a key"),
    "missing mark": (b"NNu.", "damaged"),
    "registered class": (b"\x82\x01.", "EXT1"),
    "state of a class": (b"cnumpy\ndtype\nN}U\x07convertNs\x86b.", "damaged .TypeError"),
    "state that holds itself": (MADE_ARRAY + b"q\x00(h\x00h\x00h\x00h\x00tb.", "nested too deeply"),
    "number hashed often": (
        b"\x8b" + struct.pack("<i", 1000) + bytes(999) + b"x.",
        "too many digits",
    ),
    "data outside": (b"K\x01Q.", "outside of it"),
    "buffer outside": (b"\x97.", "NEXT_BUFFER"),
    "empty": (b"", "damaged"),
    "no end": (b"]", "damaged"),
}


@contextlib.contextmanager
def _at_most(num_bytes: int) -> Iterator[None]:
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < num_bytes


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_in_bounded_memory(write, name):
    bomb, told = BOMBS[name]
    path = write(bomb)
    with _at_most(100 * _MB), pytest.raises(UserError, match=told):
        read_pickle(path)


def test_more_steps_than_a_model_file_needs_are_refused(write):
    # A step each: nothing, taken away again; in the end nothing, and the end.
    pairs = MAX_OPCODES // 2 - 1
    assert read_pickle(write(b"N0" * pairs + b"N.")) is None
    with pytest.raises(UserError, match=f"more than {MAX_OPCODES} steps"):
        read_pickle(write(b"N0" * (pairs + 1) + b"N."))


def test_shared_bytes_do_not_multiply(write):
    """A hundred arrays over the same megabyte are a hundred megabytes when they are made."""
    raw = _part(b"x" * _MB, 3)
    array = (
        MADE_ARRAY
        + b"(K\x01(%bt" % _part(_MB, 3)
        + b"cnumpy\ndtype\n(U\x02u1K\x00K\x01tR\x89j\x00\x01\x00\x00tb"
    )
    path = write(b"\x80\x03" + raw + b"r\x00\x01\x00\x000](" + array * 100 + b"e.")
    with _at_most(100 * _MB), pytest.raises(UserError, match="more memory"):
        read_pickle(path, max_bytes=50 * _MB)


def test_a_long_or_missing_file_is_refused(write, tmp_path):
    with pytest.raises(UserError, match="longer than 10 bytes"):
        read_pickle(write(pickle.dumps("x" * 20)), max_bytes=10)
    with pytest.raises(UserError, match="does not exist"):
        read_pickle(tmp_path / "nowhere")
    with pytest.raises(UserError, match="Is a directory"):
        read_pickle(tmp_path)


REAL_FORM = (
    b"\x80\x02}("
    + b"U\x01v"
    + CHUMPY_ARRAY
    + b"".join(
        _part(part)
        for part in ("J", scipy.sparse.csc_matrix(np.eye(2)), "f", np.float32(2), "t", ["x", 1.5])
    )
    + b"u."
)


@settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(st.tuples(st.integers(0, len(REAL_FORM) - 1), st.integers(0, 255)), max_size=4),
    st.just(len(REAL_FORM)) | st.integers(0, len(REAL_FORM)),
    st.binary(max_size=12),
)
def test_damaged_bytes_end_in_a_value_or_an_error_in_bounded_memory(write, changes, end, tail):
    data = bytearray(REAL_FORM)
    for place, value in changes:
        data[place] = value
    with _at_most(20 * _MB), contextlib.suppress(UserError):
        read_pickle(write(bytes(data[:end]) + tail), max_bytes=_MB)
