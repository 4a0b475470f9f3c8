"""Avatars on disk: bundles of safetensors and JSON, and nerfstudio's checkpoints without it."""

import json
import logging
import pickle
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from rgbavatar_ns.avatar.storage.head_reference import is_reference, resolve
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_folder
from rgbavatar_ns.head import ThetaLayout

BUNDLE_FORMAT = "rgbavatar-bundle"
BUNDLE_VERSION = 1
TENSORS_NAME = "avatar.safetensors"
MANIFEST_NAME = "avatar.json"

CHECKPOINT_PREFIX = "_model.avatar."
"""Where a nerfstudio checkpoint of the plugin keeps the avatar's state dict."""
CHECKPOINT_EXTRA_STATE = "_model._extra_state"
"""Where it keeps the model's extra state, whose `avatar` is `Avatar.to_state()`."""

_TENSOR_MARK = "$tensor"
_STATE_PARTS = ("config", "head", "identity", "anchors")
_log = logging.getLogger(__name__)

AvatarState = tuple[dict[str, Any], dict[str, Tensor]]
"""`Avatar.to_state()` and the avatar's state dict."""


def save_bundle(
    state: dict[str, Any],
    parameters: dict[str, Tensor],
    path: Path,
    layout: ThetaLayout,
    statistics: TrainingStatistics | None = None,
) -> None:
    """Write a bundle directory: complete or not at all; an older bundle there is replaced.

    Raises UserError where `path` is neither that nor an empty directory, or the disk refuses it.
    """
    path = path.absolute()
    ours = (path / MANIFEST_NAME).exists()
    if path.exists() and not (path.is_dir() and (ours or not any(path.iterdir()))):
        raise UserError(
            f"{path} exists and is not an avatar bundle.", "Give another path or remove it."
        )
    tensors = {f"parameters/{name}": value for name, value in parameters.items()}
    manifest = {
        "format": BUNDLE_FORMAT,
        "version": BUNDLE_VERSION,
        "layout": layout.to_json(),
        "state": _split_off_tensors(state, "state", tensors),
    }
    if statistics is not None:
        seen = statistics.to_state()
        manifest["statistics"] = _split_off_tensors(seen, "statistics", tensors)
    # Cloned, since safetensors refuses tensors that share memory.
    dense = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    with atomic_folder(path, also=(SafetensorError,)) as partial:
        save_file(dense, partial / TENSORS_NAME)
        (partial / TENSORS_NAME).chmod(0o644)  # safetensors keeps its files to their owner.
        (partial / MANIFEST_NAME).write_text(json.dumps(manifest, indent=1) + "\n")


def load_any(path: Path) -> AvatarState:
    """Read a bundle, a .ckpt file or a run folder's newest; UserError if missing or damaged."""
    if not path.exists():
        raise UserError(f"There is no {path}.", "Give a bundle, a .ckpt file or a run's folder.")
    if path.is_file():
        if path.suffix == ".ckpt":
            return _load_checkpoint(path)
        raise UserError(
            f"{path} is neither an avatar bundle nor a checkpoint.",
            f"Give the bundle's directory (it holds {MANIFEST_NAME}), a .ckpt file or a run's "
            "folder.",
        )
    if (path / MANIFEST_NAME).exists():
        return _load_bundle(path)
    for folder in (path / "nerfstudio_models", path):
        checkpoints = sorted(folder.glob("step-*.ckpt"), reverse=True)
        if checkpoints:
            return _load_newest(checkpoints)
    raise UserError(
        f"{path} holds neither {MANIFEST_NAME} nor nerfstudio_models/step-*.ckpt.",
        "Give an avatar bundle, or the folder of a run that has saved a checkpoint.",
    )


def load_statistics(path: Path) -> TrainingStatistics | None:
    """What the avatar of a bundle saw in training, if kept; raises UserError as `load_any`."""
    if not (path / MANIFEST_NAME).exists():
        return None
    manifest, tensors = _read_bundle(path)
    if "statistics" not in manifest:
        return None
    return TrainingStatistics.from_state(_join_tensors(manifest["statistics"], tensors))


def _load_bundle(path: Path) -> AvatarState:
    manifest, tensors = _read_bundle(path)
    state = _join_tensors(manifest["state"], tensors)
    if is_reference(state["head"]):
        state["head"] = resolve(state["head"], path)
    return state, _below("parameters/", tensors)


def _below(prefix: str, tensors: dict[str, Any]) -> dict[str, Any]:
    """Those whose names begin with `prefix`, without it."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _read_bundle(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Manifest and tensors, checked; raises UserError as `load_any`."""
    damaged = f"The avatar bundle {path} is damaged"
    remedy = "Save the avatar again, or use another copy."
    try:
        manifest = json.loads((path / MANIFEST_NAME).read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{damaged}: {MANIFEST_NAME}: {error}.", remedy) from error
    if not isinstance(manifest, dict) or manifest.get("format") != BUNDLE_FORMAT:
        raise UserError(
            f"{path / MANIFEST_NAME} does not describe an avatar bundle.",
            f"Give a directory written by Avatar.save (format '{BUNDLE_FORMAT}').",
        )
    if manifest.get("version") != BUNDLE_VERSION:
        raise UserError(
            f"The avatar bundle {path} has version {manifest.get('version')}; this program reads "
            f"version {BUNDLE_VERSION}.",
            "Install the version of rgbavatar_ns that wrote it.",
        )
    missing = [name for name in _STATE_PARTS if name not in manifest.get("state", {})]
    if missing:
        raise UserError(f"{damaged}: {MANIFEST_NAME} lacks {', '.join(missing)}.", remedy)
    try:
        with safe_open(path / TENSORS_NAME, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        _join_tensors(manifest, tensors)
    except (OSError, SafetensorError, KeyError) as error:
        raise UserError(f"{damaged}: {TENSORS_NAME}: {error}.", remedy) from error
    return manifest, tensors


def _load_newest(checkpoints: list[Path]) -> AvatarState:
    """Read the first that can be read of checkpoints sorted newest first."""
    errors = []
    for checkpoint in checkpoints:
        try:
            loaded = _load_checkpoint(checkpoint)
        except UserError as error:
            errors.append(error)
            _log.warning("%s Trying the one before.", error.cause)
            continue
        _log.info("Loaded %s.", checkpoint)
        return loaded
    raise errors[0]


def _load_checkpoint(path: Path) -> AvatarState:
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"The checkpoint {path} cannot be read: {reason}.", "Use an earlier one of the run."
        ) from error
    pipeline = checkpoint.get("pipeline") if isinstance(checkpoint, dict) else None
    extra = (pipeline or {}).get(CHECKPOINT_EXTRA_STATE)
    if not isinstance(extra, dict) or "avatar" not in extra:
        raise UserError(
            f"The checkpoint {path} holds no avatar.",
            "Give a checkpoint of a run of ns-train rgbavatar.",
        )
    return extra["avatar"], _below(CHECKPOINT_PREFIX, pipeline or {})


def _split_off_tensors(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """Return a JSON value in which each tensor is a reference to its entry in `tensors`."""
    if isinstance(value, Tensor):
        tensors[name] = value
        return {_TENSOR_MARK: name}
    if isinstance(value, dict):
        return {k: _split_off_tensors(v, f"{name}/{k}", tensors) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_split_off_tensors(v, f"{name}/{i}", tensors) for i, v in enumerate(value)]
    return value


def _join_tensors(value: Any, tensors: dict[str, Tensor]) -> Any:
    """Invert `_split_off_tensors`."""
    if isinstance(value, dict):
        if set(value) == {_TENSOR_MARK}:
            return tensors[value[_TENSOR_MARK]]
        return {k: _join_tensors(v, tensors) for k, v in value.items()}
    if isinstance(value, list):
        return [_join_tensors(v, tensors) for v in value]
    return value
