"""Whatever a stranger sends is refused, or taken in as a frame, and the run goes on."""

import contextlib

import pytest

from rgbavatar_ns.errors import UserError
from tests.fuzz.messages import cases


@pytest.mark.parametrize("seed", range(6))
def test_a_hostile_message_is_refused_and_the_run_goes_on(seed: int):
    for name, attack in cases(seed, 30):
        with contextlib.suppress(UserError):
            try:
                attack()
            except UserError:
                raise
            except Exception as fault:
                raise AssertionError(f"{name}: {fault!r}") from fault
