"""When a curve reaches a quality, and how batch sizes are written."""

import argparse

import pytest

from benchmarks.quality.time_to_quality import Batches, seconds_to


def test_time_to_quality_lies_between_the_curve_s_points():
    curve = {4.0: 30.0, 1.0: 26.0, 2.0: 28.0}
    assert seconds_to(29.0, curve) == pytest.approx(3.0)
    assert seconds_to(28.0, curve) == pytest.approx(2.0)
    assert seconds_to(25.0, curve) == 1.0
    assert seconds_to(31.0, curve) is None


def test_batch_sizes_as_they_are_written():
    assert Batches.parsed("10") == Batches("10", 10, 0.0, 10)
    assert Batches.parsed("4-10:20") == Batches("4-10:20", 4, 20.0, 10)
    with pytest.raises(argparse.ArgumentTypeError, match=r"'ten' is neither like 10 nor like"):
        Batches.parsed("ten")
    for wrong in ("0", "145", "4-0:2"):
        with pytest.raises(argparse.ArgumentTypeError, match="takes 1 to 144 images"):
            Batches.parsed(wrong)
