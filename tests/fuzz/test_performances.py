"""Whatever a stranger performs is refused, or numbers that a head can take."""

import contextlib

import pytest

from rgbavatar_ns.errors import UserError
from tests.fuzz.performances import cases


@pytest.mark.parametrize("seed", range(3))
def test_a_hostile_performance_is_refused_or_usable(seed):
    for name, attack in cases(seed, 200):
        with contextlib.suppress(UserError):
            try:
                attack()
            except UserError:
                raise
            except Exception as fault:
                raise AssertionError(f"{name}: {fault!r}") from fault
