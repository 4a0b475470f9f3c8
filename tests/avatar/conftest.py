import dataclasses

import pytest
import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig

from .small_head import randomize, small_head, small_identity

SMALL_CONFIG = AvatarConfig(num_bases=3, uv_resolution=10, hidden_width=16, initial_scale_m=5e-3)


@pytest.fixture
def make_avatar():
    """A builder of small avatars; `random=True` moves every Gaussian off its initial values."""

    def build(random: bool = False, dtype: torch.dtype = torch.float32, seed: int = 0, **changes):
        config = dataclasses.replace(SMALL_CONFIG, **changes)
        avatar = Avatar(small_head(), small_identity(), config, seed=seed)
        if random:
            randomize(avatar)
        return avatar.to(dtype)

    return build
