"""What a checkpoint says about the avatar beside its parameters."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from rgbavatar_ns.avatar.method import AvatarMethod, describe_layout
from rgbavatar_ns.avatar.prior import SurfacePrior
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.avatar.storage.stored_avatar import RGBAVATAR
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import ThetaLayout, is_same_identity
from rgbavatar_ns.plugin.console import say
from rgbavatar_ns.plugin.dataparser import FilmedSubject

_EXTRA_STATE = "_extra_state"
_PRIOR = "prior."


def model_state(avatar: AvatarMethod, subject: FilmedSubject) -> dict[str, Any]:
    """Tensors and plain values only, so that checkpoints load with `weights_only=True`.

    `avatar` is what `Avatar.from_state` needs; `frames` lets another program play the training
    performance without the dataset; `statistics` says what was seen in it.
    """
    # A stream's pools may be empty still.
    seen = film_statistics(avatar, subject).to_state() if len(subject.theta) else None
    return {
        "avatar": avatar.to_state(),
        "layout": avatar.layout.to_json(),
        "frames": {"theta": subject.theta, "index": list(subject.frame_index)},
        "statistics": seen,
    }


@torch.no_grad()
def film_statistics(avatar: AvatarMethod, film: FilmedSubject) -> TrainingStatistics:
    """Statistics of the training frames, with the weights that the avatar's network gives now."""
    train = list(film.train) or [0]
    theta = film.theta[train].cpu()
    psi = avatar.weights(theta.to(avatar.identity)).cpu()
    views, names = film.world_to_camera[train].cpu(), avatar.head.arrays.expression_names
    return TrainingStatistics.of(theta, psi, avatar.layout, views, names)


def require_same_layout(state_dict: Mapping[str, Any], avatar: AvatarMethod) -> None:
    """Raise UserError where the checkpoint's theta is not laid out as `avatar` takes it."""
    extra = state_dict.get(_EXTRA_STATE)
    extra = extra if isinstance(extra, dict) else {}
    make = extra.get("avatar")
    config = make.get("config") if isinstance(make, dict) else None
    if not isinstance(config, dict):
        raise UserError(
            "The checkpoint holds no avatar of this method.",
            "Load a checkpoint that `ns-train rgbavatar` or `ns-train rgbavatar-tiny` wrote.",
        )
    method = make.get("method", RGBAVATAR) if isinstance(make, dict) else RGBAVATAR
    if method != avatar.method:
        raise UserError(
            f"The checkpoint's avatar is one of {method}, not of {avatar.method}.",
            f"Go on with `ns-train {method}`, or load a checkpoint of this method.",
        )
    saved = ThetaLayout.from_json(extra.get("layout"))
    if saved != avatar.layout:
        raise UserError(
            f"The checkpoint was trained with theta of {describe_layout(saved)}, but the dataset "
            f"has theta of {describe_layout(avatar.layout)}.",
            "Use the dataset that the checkpoint was trained with (--data), or another one "
            "tracked with the same head model.",
        )
    _require_same_make(config, avatar)


def tell_another_person(state_dict: Mapping[str, Any], subject: FilmedSubject) -> None:
    """Say where the checkpoint's head is not that of the dataset, as after tracking anew."""
    saved = state_dict.get("avatar.identity")
    mine = subject.identity
    if not isinstance(saved, torch.Tensor) or saved.shape != mine.shape:
        return
    if not is_same_identity(saved, mine):
        say(
            "note: the checkpoint's person was measured otherwise than this data's, which is of "
            "another one or was tracked anew since. The avatar may lie beside the pictures: train "
            "it anew, or name the dataset that it was trained on.",
        )


def with_prior(state_dict: dict[str, Any], prior: SurfacePrior | None) -> dict[str, Any]:
    """Return the state with all that a prior has, and without where the model has none.

    A run that began without a prior, or without its views, goes on without: a fresh one does
    nothing. What holds neighbours together is known anew when the prior looks next.
    """
    if prior is None:
        return {k: v for k, v in state_dict.items() if not k.startswith(_PRIOR)}
    return {_PRIOR + name: value for name, value in prior.state_dict().items()} | state_dict


@contextmanager
def misfits_told() -> Iterator[None]:
    """Tell parameters that are missing or of another shape as a UserError.

    nerfstudio would take what fits of them, and leave the others as they are.
    """
    try:
        yield
    except (RuntimeError, TypeError, AttributeError) as error:
        lines = [line.strip().rstrip(".") for line in str(error).splitlines() if line.strip()]
        raise UserError(
            f"The checkpoint's parameters are not this model's: {'; '.join(lines)}.",
            "Use another checkpoint, or the dataset that this one was trained with.",
        ) from error


def _require_same_make(saved: dict[str, Any], avatar: AvatarMethod) -> None:
    mine = avatar.config.to_json()
    different = [name for name in avatar.make_options if saved.get(name) != mine[name]]
    if different:
        told = ", ".join(f"{name} {saved.get(name)}, not {mine[name]}" for name in different)
        flags = " ".join(
            f"--pipeline.model.avatar.{name.replace('_', '-')} {saved.get(name)}"
            for name in different
        )
        raise UserError(f"The checkpoint's avatar has {told}.", f"Pass {flags}.")
