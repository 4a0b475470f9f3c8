"""Avatars, as the avatar's own tests make them."""

from tests.avatar.conftest import make_avatar

__all__ = ["make_avatar"]
