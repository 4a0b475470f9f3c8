"""An avatar as it lies in a file, judged before anything is built or allocated for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rgbavatar_ns.avatar.config import AvatarConfig
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.reading import DamagedFileError, damage_told

RGBAVATAR = "rgbavatar"
"""The method of files that name none."""
_MAX_RESOLUTION = 1 << 15
_INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
_FLOATS = (torch.float16, torch.float32, torch.float64)
# Axes that bear the same letter have the same length, which a number says at once.
_HEAD = {
    "v_template": (_FLOATS, ("V", 3)),
    "shapedirs": (_FLOATS, ("V", 3, "C")),
    "posedirs": (_FLOATS, ("V", 3, 36)),
    "joint_regressor": (_FLOATS, (5, "V")),
    "parents": (_INTEGERS, (5,)),
    "skinning_weights": (_FLOATS, ("V", 5)),
    "faces": (_INTEGERS, ("F", 3)),
    "uv": (_FLOATS, ("VT", 2)),
    "uv_faces": (_INTEGERS, ("F", 3)),
}
_ANCHORS = {
    "triangle_index": (_INTEGERS, ("N",)),
    "barycentric": (_FLOATS, ("N", 3)),
    "texel_row_col": (_INTEGERS, ("N", 2)),
}
_GAUSSIANS = {
    "anchors.triangle_index": (_INTEGERS, ("N",)),
    "blendshapes.position": (_FLOATS, ("N", 3)),
}
_BASES = {"blendshapes.basis_position": (_FLOATS, ("K", "N", 3))}
_LAYERS = {"weight_network.layers.0.weight": (_FLOATS, ("W", "features"))}
_NEVER_EMPTY = ("V", "VT", "F", "N")
_Shapes = dict[str, tuple[tuple[torch.dtype, ...], tuple[str | int, ...]]]


@dataclass(frozen=True)
class StoredAvatar:
    """`Avatar.to_state()`, the avatar's state dict, and theta's layout in JSON, where it is told.

    All three as a stranger may have written them.
    """

    path: Path
    state: dict[str, Any]
    parameters: dict[str, Any]
    layout: Any = None
    statistics: Any = None
    """What `TrainingStatistics.from_state` takes, if there is any."""
    refined_frames: Any = None
    """What `RefinedFrames.of_stored` takes: of a run that refined its tracking, its frames."""

    @property
    def method(self) -> str:
        """The method that made it; files of before there were others do not say."""
        method = self.state.get("method", RGBAVATAR) if isinstance(self.state, dict) else RGBAVATAR
        if not isinstance(method, str):
            with self.damage_told():
                raise DamagedFileError("its method has no name")
        return method

    def statistics_of(self, layout: ThetaLayout) -> TrainingStatistics | None:
        """What it saw in training, if the file kept it; raises UserError where that is damaged."""
        known = self.statistics is not None
        return TrainingStatistics.from_state(self.statistics, layout) if known else None

    @contextmanager
    def damage_told(self) -> Iterator[None]:
        """Whatever goes wrong within is told as a UserError about this file."""
        with damage_of(self.path):
            yield

    def check(self) -> None:
        """Raise UserError unless sizes agree with one another and with the file's own tensors.

        So nothing that is built from it takes more than a multiple of the file. Whether indices lie
        inside of what they point into is asked where they are used.
        """
        with self.damage_told():
            sizes: dict[str, int] = {}
            _check_head(_mapping(self.state, "head"), sizes)
            _check_tensors(self.state, {"identity": (_FLOATS, ("I",))}, sizes)
            if self.method != RGBAVATAR:
                return  # what it has beside is compared with what its config builds
            anchors = _mapping(self.state, "anchors")
            _check_tensors(anchors, _ANCHORS, sizes)
            resolution = anchors.get("resolution")
            if type(resolution) is not int or not 0 < resolution <= _MAX_RESOLUTION:
                raise DamagedFileError("its UV map has an impossible resolution")
            config = AvatarConfig.from_json(_mapping(self.state, "config"))
            sizes["K"], needed = config.num_bases, dict[str, Any](_GAUSSIANS)
            if config.num_bases > 0:
                needed |= _BASES
                if config.weight_network != "none":
                    mlp = config.weight_network == "mlp"
                    sizes["W"] = config.hidden_width if mlp else config.num_bases
                    needed |= _LAYERS
            _check_tensors(self.parameters, needed, sizes)

    def check_fits(self, own: dict[str, Tensor], layout: list[dict[str, Any]]) -> None:
        """Raise UserError unless these are the parameters and the layout of what was built."""
        missing = sorted(set(own) - set(self.parameters))
        if missing:
            raise UserError(
                f"{self.path} lacks parts of the avatar: {', '.join(missing)}.",
                "Use another checkpoint, or save the avatar again.",
            )
        with self.damage_told():
            for name, wanted in own.items():
                kinds = _FLOATS if wanted.is_floating_point() else (*_INTEGERS, torch.bool)
                _check_tensors(self.parameters, {name: (kinds, tuple(wanted.shape))}, {})
            if self.layout is not None and self.layout != layout:
                raise DamagedFileError("its layout of theta is not that of its head model")


@contextmanager
def damage_of(path: Path) -> Iterator[None]:
    """Whatever goes wrong within is told as a UserError about this avatar's file."""
    told = None
    try:
        with damage_told():
            try:
                yield
            except UserError as error:
                told = error
    except DamagedFileError as error:
        raise UserError(
            f"The avatar {path} is damaged: {error}.", "Save it again, or use another copy."
        ) from error
    if told is not None:
        raise told


def _mapping(values: Any, name: str) -> dict[str, Any]:
    """The part of this name, if it is a mapping."""
    part = values.get(name) if isinstance(values, dict) else None
    if not isinstance(part, dict):
        raise DamagedFileError(f"it lacks {name}")
    return part


def _check_tensors(values: dict[str, Any], shapes: _Shapes, sizes: dict[str, int]) -> None:
    """Raise DamagedFileError where one is of another kind or shape; `sizes` learns its axes."""
    for name, (kinds, axes) in shapes.items():
        value = values.get(name)
        if not isinstance(value, Tensor) or value.dtype not in kinds or value.ndim != len(axes):
            raise DamagedFileError(f"it lacks {name}, or has something else there")
        for axis, size in zip(axes, value.shape):
            wanted = sizes.setdefault(axis, size) if isinstance(axis, str) else axis
            if size != wanted or (size == 0 and axis in _NEVER_EMPTY):
                raise DamagedFileError(f"its {name} has the shape {list(value.shape)}")


def _check_head(head: dict[str, Any], sizes: dict[str, int]) -> None:
    """What HeadArrays, which knows how its parts fit together, takes for granted."""
    _check_tensors(head, _HEAD, sizes)
    for name in head:
        if name.startswith("group_"):
            _check_tensors(head, {name: (_INTEGERS, ("group",))}, {})
    if "eyelid_dirs" in head:
        _check_tensors(head, {"eyelid_dirs": (_FLOATS, ("V", 3, 2))}, sizes)
    names = head.get("expression_names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DamagedFileError("it lacks expression_names")
    sizes["I"] = head["num_identity"]
    if type(sizes["I"]) is not int or sizes["I"] < 0 or type(head["name"]) is not str:
        raise DamagedFileError("its head model has no name, or an impossible num_identity")
    for joint, parent in enumerate(head["parents"].tolist()):
        if not (0 <= parent < joint or (joint == 0 and parent == -1)):
            raise DamagedFileError("the joints of its head model do not follow their parents")
