"""Whole numbers in columns: how far they are off, and that they come back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbavatar_ns.export.stored_array import StoredArray, exact, ranged, stepped, unpacked


def _back(array: StoredArray) -> np.ndarray:
    return unpacked(array.described(), array.packed(0, array.items))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["int8", "int16"]), st.floats(1e-6, 1e3))
def test_a_stepped_number_is_off_by_half_a_unit_at_most(seed, stored, step):
    values = np.random.default_rng(seed).standard_normal((4, 40))
    values[1] = 0
    array = stepped(values, step, stored)
    assert array.unit is not None
    assert (np.abs(_back(array) - values) <= 0.5001 * array.unit[:, None] + 1e-6).all()
    reach = np.abs(values).max(1) / np.iinfo(stored).max
    np.testing.assert_allclose(array.unit, np.maximum(reach, step))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["uint8", "uint16"]))
def test_a_ranged_number_is_off_by_half_of_the_ranges_steps(seed, stored):
    values = np.random.default_rng(seed).uniform(0.1, 9, (3, 50))
    values[2] = 7.5
    off = np.abs(_back(ranged(values, stored)) - values).max(1)
    assert (off <= 0.5001 * np.ptp(values, axis=1) / np.iinfo(stored).max + 1e-6).all()
    ratio = np.abs(np.log(_back(ranged(values, stored, logarithmic=True)) / values)).max(1)
    assert (ratio <= 0.5001 * np.ptp(np.log(values), axis=1) / np.iinfo(stored).max + 1e-6).all()


@pytest.mark.parametrize(
    ("stored", "differences"),
    [
        *((whole, steps) for whole in ("int8", "int16", "uint16", "uint32") for steps in (0, 1)),
        ("float32", 0),
    ],
)
def test_slices_come_back_whatever_the_type(stored, differences):
    rng = np.random.default_rng(0)
    ends = np.iinfo(stored) if stored != "float32" else None
    values = (
        rng.standard_normal((30, 2))
        if ends is None
        else rng.integers(ends.min, ends.max, (30, 2), endpoint=True)
    )
    array = exact(values, stored, differences=bool(differences))
    for first, last in ((0, 30), (0, 11), (11, 30), (7, 7)):
        back = unpacked(array.described(), array.packed(first, last))
        assert np.array_equal(back.T, values[first:last].astype(stored))


def test_bytes_of_16_bits_by_hand():
    # -1, 1, 256 are stored as 1, 2, 512: all low bytes, then all high ones.
    array = exact(np.array([-1, 1, 256]), "int16")
    assert array.packed(0, 3) == bytes([1, 2, 0, 0, 0, 2])
    array = exact(np.array([5, 7, 6]), "uint16", differences=True)
    assert array.packed(0, 3) == bytes([5, 2, 255, 0, 0, 255])
