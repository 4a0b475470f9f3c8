"""Avatars on disk: bundles of safetensors and JSON, and nerfstudio's checkpoints without it."""

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save_file
from torch import Tensor

from rgbavatar_ns.avatar.storage.checkpoint_file import (
    MODELS_FOLDER,
    checkpoints_of,
    newest_run,
    read_checkpoint,
    read_newest,
)
from rgbavatar_ns.avatar.storage.head_reference import is_reference, resolve
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.avatar.storage.stored_avatar import StoredAvatar, damage_of
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_folder, digest
from rgbavatar_ns.head import ThetaLayout
from rgbavatar_ns.reading import DamagedFileError, damage_told, load_json, read_file

BUNDLE_FORMAT = "rgbavatar-bundle"
BUNDLE_VERSION = 1
TENSORS_NAME = "avatar.safetensors"
MANIFEST_NAME = "avatar.json"

CHECKPOINT_PREFIX = "_model.avatar."
"""Where a nerfstudio checkpoint of the plugin keeps the avatar's state dict."""
CHECKPOINT_EXTRA_STATE = "_model._extra_state"
"""Where it keeps the model's extra state, whose `avatar` is `Avatar.to_state()`."""
_CHECKPOINT_REFINEMENT = "_model.refinement."
"""Where it keeps the corrections of refined tracking, if there are any."""

_TENSOR_MARK = "$tensor"
_STATE_PARTS = ("config", "head", "identity")
_CHECKSUMS = "sha256"
_PARTS = ("format", "version", "layout", "state", "statistics", _CHECKSUMS)
_MAX_MANIFEST_BYTES = 1 << 26
_MAX_TENSORS_BYTES = 1 << 34
_log = logging.getLogger(__name__)


def save_bundle(
    state: dict[str, Any],
    parameters: dict[str, Tensor],
    path: Path,
    layout: ThetaLayout,
    statistics: TrainingStatistics | None = None,
) -> None:
    """Write a bundle directory: complete or not at all; an older bundle there is replaced.

    Raises UserError where `path` is neither that alone nor an empty directory, or the disk refuses
    it.
    """
    path = path.absolute()
    if path.exists():
        there = set(os.listdir(path)) if path.is_dir() else {path.name}
        if there and (MANIFEST_NAME not in there or there - {MANIFEST_NAME, TENSORS_NAME}):
            raise UserError(
                f"{path} exists and is not an avatar bundle, or holds other files too.",
                "Give another path or remove it.",
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
        manifest[_CHECKSUMS] = {
            TENSORS_NAME: digest([(partial / TENSORS_NAME).read_bytes()]),
            MANIFEST_NAME: _manifest_digest(manifest),
        }
        (partial / MANIFEST_NAME).write_text(json.dumps(manifest, indent=1) + "\n")


def _manifest_digest(manifest: dict[str, Any]) -> str:
    """SHA-256 of what a manifest says beside its checksums, as JSON in a form of its own."""
    rest = {key: value for key, value in manifest.items() if key != _CHECKSUMS}
    return digest([json.dumps(rest, sort_keys=True, separators=(",", ":"))])


def load_any(path: Path) -> StoredAvatar:
    """Read a bundle, a .ckpt file or a run folder's newest; UserError if missing or damaged.

    What it gives is whole, yet may be a stranger's: `StoredAvatar.check` judges it.
    """
    if not os.path.exists(path):
        raise UserError(f"There is no {path}.", "Give a bundle, a .ckpt file or a run's folder.")
    if not os.path.isdir(path):
        if path.suffix == ".ckpt":
            return _load_checkpoint(path)
        raise UserError(
            f"{path} is neither an avatar bundle nor a checkpoint.",
            f"Give the bundle's directory (it holds {MANIFEST_NAME}), a .ckpt file or a run's "
            "folder.",
        )
    if (path / MANIFEST_NAME).exists():
        return _load_bundle(path)
    checkpoints = checkpoints_of(newest_run(path))
    if not checkpoints:
        raise UserError(
            f"{path} holds neither {MANIFEST_NAME} nor {MODELS_FOLDER}/step-*.ckpt.",
            "Give an avatar bundle, or the folder of a run that has saved a checkpoint, or of an "
            "experiment with such a run.",
        )
    stored, chosen = read_newest(checkpoints, _load_checkpoint, _log.warning)
    _log.info("Loaded %s.", chosen)
    return stored


def _load_bundle(path: Path) -> StoredAvatar:
    manifest, tensors = _read_bundle(path)
    state = manifest["state"]
    with damage_of(path):
        if is_reference(state["head"]):
            state["head"] = resolve(state["head"], path)
    parameters = _below("parameters/", tensors)
    seen = manifest.get("statistics")
    return StoredAvatar(path, state, parameters, manifest.get("layout"), seen)


def _below(prefix: str, tensors: dict[str, Any]) -> dict[str, Any]:
    """Those whose names begin with `prefix`, without it."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def _read_bundle(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Manifest, its references replaced by their tensors, and all tensors."""
    with _damage_of_part(path, MANIFEST_NAME):
        manifest = load_json(path / MANIFEST_NAME, _MAX_MANIFEST_BYTES)
    _require_known_kind(manifest, path)
    with _damage_of_part(path, MANIFEST_NAME):
        if unknown := sorted(set(manifest) - set(_PARTS)):
            raise DamagedFileError(f"it has the unknown parts {', '.join(unknown)}")
        # Bundles of before have no checksums.
        written = manifest.get(_CHECKSUMS, {})
        if written and written.get(MANIFEST_NAME) != _manifest_digest(manifest):
            raise DamagedFileError("it is not as it was written")
        state = manifest.get("state", {})
        if missing := [name for name in _STATE_PARTS if name not in state]:
            raise DamagedFileError(f"it lacks {', '.join(missing)}")
    with _damage_of_part(path, TENSORS_NAME):
        content = read_file(path / TENSORS_NAME, _MAX_TENSORS_BYTES)
        if written and written.get(TENSORS_NAME) != digest([content]):
            raise DamagedFileError("it is not as it was written")
        tensors = load(content)
        return _join_tensors(manifest, tensors), tensors


def _require_known_kind(manifest: Any, path: Path) -> None:
    """Raise UserError for a manifest of something else, or of another version."""
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


@contextmanager
def _damage_of_part(path: Path, name: str) -> Iterator[None]:
    """Tell all that goes wrong with a part of a bundle as a UserError."""
    try:
        with damage_told():
            yield
    except DamagedFileError as error:
        raise UserError(
            f"The avatar bundle {path} is damaged: {name}: {error}.",
            "Save the avatar again, or use another copy.",
        ) from error


def _load_checkpoint(path: Path) -> StoredAvatar:
    pipeline = read_checkpoint(path).get("pipeline")
    extra = pipeline.get(CHECKPOINT_EXTRA_STATE) if isinstance(pipeline, dict) else None
    if not isinstance(extra, dict) or not isinstance(extra.get("avatar"), dict):
        raise UserError(
            f"The checkpoint {path} holds no avatar.",
            "Give a checkpoint of a run of ns-train rgbavatar.",
        )
    with damage_of(path):
        parameters = _below(CHECKPOINT_PREFIX, pipeline or {})
        refined = any(name.startswith(_CHECKPOINT_REFINEMENT) for name in pipeline or {})
        frames = extra.get("frames", {}) if refined else None
    seen = extra.get("statistics")
    return StoredAvatar(path, extra["avatar"], parameters, extra.get("layout"), seen, frames)


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
            name = value[_TENSOR_MARK]
            if not isinstance(name, str) or name not in tensors:
                raise DamagedFileError(f"it has no tensor {str(name)[:80]!a}")
            return tensors[name]
        return {k: _join_tensors(v, tensors) for k, v in value.items()}
    if isinstance(value, list):
        return [_join_tensors(v, tensors) for v in value]
    return value
