"""All kinds of hostile inputs, many of each; `python -m tests.fuzz` prints the table."""

import pytest

from tests.fuzz import options
from tests.fuzz.__main__ import kinds, run

COUNT, SEED = 4_000, 0


@pytest.mark.nightly
def test_thousands_of_hostile_inputs_are_refused_or_change_nothing():
    assert run(kinds(), SEED, COUNT) == 0


@pytest.mark.slow
def test_a_few_absurd_options_of_every_command_are_refused(capsys):
    from rgbavatar_ns.errors import UserError

    for name, act in options.cases(SEED, 60):
        try:
            act()
        except UserError:
            continue
        finally:
            told = capsys.readouterr().err
            assert "Traceback" not in told, name
