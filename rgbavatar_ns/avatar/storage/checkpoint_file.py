"""A run's checkpoints: listed, read with every byte verified, the newest that can be read.

`torch.load` knows no checksums, unpacks compressed members of any size, and with
`weights_only=True` still makes `bytearray(2**40)` or a tensor of 2**40 numbers out of one. So the
zip and the pickle within are judged before it sees them, and its tensors after.
"""

import io
import os
import re
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import torch
from torch import Tensor

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.safe_pickle import StandIn, stand_in, unpickle
from rgbavatar_ns.reading import DamagedFileError, regular_file

MODELS_FOLDER = "nerfstudio_models"
"""Where a run's folder has its checkpoints."""
CONFIG_NAME, SUMMARY_NAME = "config.yml", "training.json"
"""Beside them: what nerfstudio makes the run of again, and how the run ended."""
_NAME = re.compile(r"step-([0-9]{9,18})\.ckpt")
_MAX_OPCODES = 5_000_000
"""A run lists one number for each of its frames."""
_MAX_DEPTH = 100
_SHARED_TIMES = 4
"""Tensors may share their numbers, but not to become many times what the file holds."""
_NUMBER_BYTES = {
    **dict.fromkeys(("Double", "Long", "ComplexFloat"), 8),
    **dict.fromkeys(("Float", "Int"), 4),
    **dict.fromkeys(("Half", "BFloat16", "Short"), 2),
    **dict.fromkeys(("Char", "Byte", "Bool"), 1),
}
Read = TypeVar("Read")


def list_checkpoints(folder: Path) -> list[tuple[int, Path]]:
    """Step and path of the checkpoints in `folder`, oldest first; empty if there is no folder."""
    if not os.path.isdir(folder):
        return []
    named = ((_NAME.fullmatch(path.name), path) for path in folder.iterdir())
    return sorted((int(name.group(1)), path) for name, path in named if name)


def checkpoints_of(folder: Path) -> list[Path]:
    """Those in a folder, or in a run's folder, oldest first."""
    found = list_checkpoints(folder) or list_checkpoints(folder / MODELS_FOLDER)
    return [path for _, path in found]


def newest_run(folder: Path) -> Path:
    """The run that was saved last of those in an experiment's or a method's folder, or `folder`.

    That is ns-train's OUTPUT/EXPERIMENT/METHOD/RUN, two levels deep at most.
    """
    if not os.path.isdir(folder) or checkpoints_of(folder):
        return folder
    found = [
        (checkpoints[-1].stat().st_mtime_ns, models.parent)
        for levels in ("*", "*/*")
        for models in folder.glob(f"{levels}/{MODELS_FOLDER}")
        if not models.parent.is_symlink() and (checkpoints := checkpoints_of(models))
    ]
    return max(found)[1] if found else folder


def read_newest(
    checkpoints: Sequence[Path], read: Callable[[Path], Read], tell: Callable[[str], object]
) -> tuple[Read, Path]:
    """What `read` gives of the newest that it can read; they come oldest first, at least one.

    Tells which are passed over; raises UserError where all are.
    """
    causes: list[str] = []
    for path in reversed(checkpoints):
        try:
            return read(path), path
        except UserError as error:
            causes.append(error.cause)
            tell(f"Passing over a checkpoint: {error.cause}")
    raise UserError(
        f"None of the {len(checkpoints)} checkpoints in {checkpoints[0].parent} can be read. "
        f"{causes[0]}",
        "Use those of another run, or train again.",
    )


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Plain containers, numbers, texts and CPU tensors, which take no more than the file does.

    Raises UserError where there is none, or it is damaged or holds anything else.
    """
    if not os.path.exists(path):
        raise UserError(f"There is no checkpoint {path}.", "Check the path and the step.")
    try:
        with regular_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            _verify(file, size)
            file.seek(0)
            state = torch.load(file, map_location="cpu", weights_only=True)
            return _Plain(_SHARED_TIMES * size).mapping(state)
    except DamagedFileError as error:
        raise UserError(
            f"The checkpoint {path} cannot be read: {error}.", "Use another one of the run."
        ) from error


def _verify(file: BinaryIO, size: int) -> None:
    """Raise an exception unless it is a zip of torch.save, whole, and plain by its pickle."""
    with zipfile.ZipFile(file) as archive:
        members = {member.filename: member for member in archive.infolist()}
        if len(members) < len(archive.infolist()):
            raise DamagedFileError("it has two members of one name")
        if any(one.compress_type != zipfile.ZIP_STORED for one in members.values()):
            raise DamagedFileError("it has compressed members, unlike what torch.save writes")
        if sum(one.file_size for one in members.values()) > size:
            raise DamagedFileError("its members claim more bytes than it has")
        damaged = archive.testzip()
        if damaged is not None:
            raise DamagedFileError(f"its member {damaged!a} is damaged")
        pickles = [name for name in members if re.fullmatch(r"[^/]+/data\.pkl", name)]
        if len(pickles) != 1:
            raise DamagedFileError("it is a zip, but not one that torch.save wrote")
        folder = pickles[0].removesuffix("data.pkl")

        def storage(persistent_id: Any) -> StandIn:
            what, kind, key, _, count = persistent_id
            held = members[f"{folder}data/{key}"].file_size
            name = kind.name.removeprefix("torch.").removesuffix("Storage")
            if what != "storage" or type(count) is not int or held != count * _NUMBER_BYTES[name]:
                raise DamagedFileError("a storage is not as long as it claims")
            return _Inert()

        unpickle(io.BytesIO(archive.read(pickles[0])), _NAMES, storage, _MAX_OPCODES)


class _Inert(StandIn):
    """Takes items as well, like an OrderedDict."""

    __slots__ = ()
    name = "inert"

    def __setitem__(self, key: object, value: object) -> None:
        """Forget it."""


def _never(made: StandIn, resolve: Any) -> Any:
    raise NotImplementedError  # Only torch makes values of these.


_NAMES: dict[str, type[StandIn]] = {
    "collections.OrderedDict": _Inert,
    **{
        name: stand_in(name, _never)
        for name in (
            "torch._utils._rebuild_tensor_v2",
            "torch._utils._rebuild_parameter",
            *(f"torch.{name}Storage" for name in _NUMBER_BYTES),
        )
    },
}
"""All that a checkpoint's pickle names; `bytearray` and `_codecs.encode` can take any memory."""


class _Plain:
    """Copies containers as plain ones, shared ones once, and refuses other values."""

    def __init__(self, max_bytes: int) -> None:
        self._left = max_bytes
        self._done: dict[int, Any] = {}

    def mapping(self, value: Any) -> dict[str, Any]:
        """The copy of a dict whose keys are texts."""
        if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
            raise DamagedFileError("it holds no named values")
        return self(value, 0)

    def __call__(self, value: Any, depth: int) -> Any:
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if id(value) not in self._done:
            if depth > _MAX_DEPTH:
                raise DamagedFileError("it is nested too deeply")
            self._done[id(value)] = self._copied(value, depth + 1)
        return self._done[id(value)]

    def _copied(self, value: Any, depth: int) -> Any:
        if isinstance(value, Tensor):
            return self._dense(value)
        if isinstance(value, dict):
            return {key: self(item, depth) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return type(value)(self(item, depth) for item in value)
        raise DamagedFileError(f"it holds a {type(value).__name__}")

    def _dense(self, value: Tensor) -> Tensor:
        claimed = value.numel() * value.element_size()
        self._left -= claimed
        if claimed > value.untyped_storage().nbytes() or self._left < 0:
            raise DamagedFileError(f"a tensor of shape {list(value.shape)} claims too much")
        return value.detach()
