import pytest

from rgbavatar_ns.errors import UserError
from tests.fuzz import avatars


def test_damaged_and_hostile_avatars_are_told_or_whole():
    refused = 0
    for name, attack in avatars.cases(seed=1, count=240):
        try:
            attack()
        except UserError:
            refused += 1
        except Exception as error:
            pytest.fail(f"{name}: {error!r}")
    assert 100 < refused < 240
