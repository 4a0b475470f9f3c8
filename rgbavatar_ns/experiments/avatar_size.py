"""How much an avatar is: its Gaussians, and the megabytes that it is stored in."""

from rgbavatar_ns.avatar.method import AvatarMethod


def avatar_size(avatar: AvatarMethod) -> dict[str, int | float]:
    """Return `gaussians`, their number, and `megabytes`: 10^6 bytes of all that was learnt.

    Of every parameter, of Gaussians and networks alike, in the precision in which it is trained and
    saved. Ours, because files differ in what they pack beside it: the head model, which every
    method needs and all share, does not count, nor what is laid out on it and is not learnt (where
    Gaussians are anchored), nor Adam's state.
    """
    learnt = sum(parameter.numel() * parameter.element_size() for parameter in avatar.parameters())
    return {"gaussians": avatar.num_gaussians, "megabytes": learnt / 1e6}
