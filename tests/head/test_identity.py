"""Two measures of one person are told from those of two."""

import torch

from rgbavatar_ns.head import is_same_identity


def test_an_identity_is_the_same_but_for_rounding():
    identity = torch.linspace(-1, 1, 60)
    assert is_same_identity(identity, identity.double() + 5e-5)
    assert is_same_identity(identity.half(), identity.half().float())
    assert not is_same_identity(identity, identity + 1e-3)
    assert not is_same_identity(identity, -identity)
    assert not is_same_identity(identity, identity[:1].expand(59))
    assert not is_same_identity(identity[:1], identity[:1].expand(60))
