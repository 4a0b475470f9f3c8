"""A few attacks of each kind in every run of the tests; the fuzz runner makes thousands."""

import pytest

from rgbavatar_ns.errors import UserError
from tests.fuzz import heads, importers, native, performances, pickles

QUICK = {pickles: 120, heads: 200, native: 120, importers: 120, performances: 600}


@pytest.mark.parametrize("module", QUICK, ids=lambda module: module.NAME)
def test_attacks_are_refused_or_change_nothing(module):
    for name, attack in module.cases(seed=1, count=QUICK[module]):
        try:
            attack()
        except UserError:
            continue
        except BaseException as error:
            raise AssertionError(f"{name}: {error!r}") from error
