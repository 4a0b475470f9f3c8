"""Avatars of any method from their files, and what only RGBAvatar's can give."""

import pytest
import torch

from rgbavatar_ns.avatar.loading import METHODS, load_avatar, require_rgbavatar
from rgbavatar_ns.avatar.methods.gaussianblendshapes import (
    GaussianBlendshapes,
    GaussianBlendshapesConfig,
)
from rgbavatar_ns.avatar.storage.bundle import save_bundle
from rgbavatar_ns.errors import UserError
from tests.avatar.small_head import front_camera, random_theta, small_head, small_identity


def rival() -> GaussianBlendshapes:
    return GaussianBlendshapes(
        small_head(), small_identity(), GaussianBlendshapesConfig(num_points=30)
    )


def test_each_method_bears_its_own_name():
    assert all(kind.method == name for name, kind in METHODS.items())
    assert {"rgbavatar", "gaussianblendshapes-style"} <= METHODS.keys()


def test_a_bundle_opens_as_what_it_was(make_avatar, tmp_path):
    for avatar in (make_avatar(random=True), rival()):
        avatar.save(tmp_path / avatar.method)
        loaded = load_avatar(tmp_path / avatar.method)
        assert type(loaded) is type(avatar)
        theta, camera = random_theta(avatar.layout, 2), front_camera()
        assert torch.equal(loaded.render(theta, camera).image, avatar.render(theta, camera).image)


def test_a_method_that_nobody_knows_is_told_with_those_that_are_known(tmp_path):
    avatar = rival()
    state = avatar.to_state() | {"method": "nobody's\x1b[31m"}
    save_bundle(state, avatar.own_state_dict(), tmp_path / "bundle", avatar.layout)
    with pytest.raises(UserError, match=r"nobody's\\x1b\[31m.*rgbavatar, gaussianavatars") as told:
        load_avatar(tmp_path / "bundle")
    assert "\x1b" not in str(told.value)
    with pytest.raises(UserError, match="There is no"):
        load_avatar(tmp_path / "none")


def test_what_needs_bases_is_refused_for_others(make_avatar):
    avatar = make_avatar()
    assert require_rgbavatar(avatar, "A page") is avatar
    with pytest.raises(UserError, match=r"A page needs the bases.*gaussianblendshapes-style.*ply"):
        require_rgbavatar(rival(), "A page")
