"""Avatars of any method, from their files."""

from pathlib import Path

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.methods.flashavatar import FlashAvatar
from rgbavatar_ns.avatar.methods.gaussianavatars import GaussianAvatars
from rgbavatar_ns.avatar.methods.gaussianblendshapes import GaussianBlendshapes
from rgbavatar_ns.avatar.methods.monogaussianavatar import MonoGaussianAvatar
from rgbavatar_ns.avatar.methods.splattingavatar import SplattingAvatar
from rgbavatar_ns.avatar.storage.bundle import load_any
from rgbavatar_ns.errors import UserError

METHODS: dict[str, type[AvatarMethod]] = {
    kind.method: kind
    for kind in (
        Avatar,
        GaussianAvatars,
        SplattingAvatar,
        FlashAvatar,
        GaussianBlendshapes,
        MonoGaussianAvatar,
    )
}
"""By the names that files bear."""


def load_avatar(path: str | Path) -> AvatarMethod:
    """Load what any method wrote: a bundle, a checkpoint (.ckpt) or a run's folder, its newest.

    Needs no nerfstudio. Raises UserError where there is none, it cannot be read, or its method is
    none of `METHODS`.
    """
    stored = load_any(Path(path))
    if stored.method not in METHODS:
        raise UserError(
            f"The avatar {path} is one of {stored.method[:80]!a}, unknown to this version.",
            f"Give one of {', '.join(METHODS)}, or update rgbavatar_ns.",
        )
    return METHODS[stored.method].of_stored(stored)


def require_rgbavatar(avatar: AvatarMethod, needed_for: str) -> Avatar:
    """Return an RGBAvatar as such; raises UserError for other methods, saying what they can give.

    needed_for: what asks for its bases, UV map or tangent frames, as the beginning of a sentence.
    """
    if isinstance(avatar, Avatar):
        return avatar
    raise UserError(
        f"{needed_for} needs the bases and the UV map of {Avatar.method}; this avatar is one of "
        f"{avatar.method}.",
        "Ask for films and pictures (`rgbavatar render`), a bundle, or files of Gaussians (ply, "
        "gltf, spz, compressed-ply, sog).",
    )
