"""A head model that is sent with a stream's subject: of bounded work, and fit for use."""

from typing import Any

import numpy as np
import safetensors.numpy
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from rgbavatar_ns.head import HeadArrays, HeadModel, uv_anchors
from rgbavatar_ns.reading import DamagedFileError, damage_told

HEAD_FIELDS = ("num_identity", "expression_names")
"""What goes beside the arrays, as JSON."""
_MOST_BYTES = 40 << 20
"""FLAME's largest, with float32 directions, has 27 MB."""
_MOST_VERTICES, _MOST_FACES, _MOST_ARRAYS = 50_000, 100_000, 40
_FARTHEST_M = 100.0
_MOST_UV_AREA = 20.0
"""Of the boxes around all triangles of the UV map; a map without overlaps has two or three."""
_TRIED_RESOLUTION = 32
_INDICES = ("parents", "faces", "uv_faces")
_GROUP = "group_"


def pack_head(arrays: HeadArrays) -> tuple[dict[str, Any], bytes]:
    """A head as fields of a message and as its payload."""
    state = arrays.to_state()
    tensors = {name: value.numpy() for name, value in state.items() if torch.is_tensor(value)}
    return {name: state[name] for name in HEAD_FIELDS}, safetensors.numpy.save(tensors)


def unpack_head(
    payload: bytes, fields: dict[str, Any], name: str, identity: Float[Tensor, "_"]
) -> HeadArrays:
    """Inverse of `pack_head`; the head is posed once, for it must not end the run later.

    Raises DamagedFileError for what is none, for one that is too large, not finite, or larger than
    100 m where it is posed, and for one whose UV map carries nothing or folds many times.
    """
    if len(payload) > _MOST_BYTES:
        raise DamagedFileError(f"its head has more than {_MOST_BYTES} bytes")
    with damage_told():
        loaded = safetensors.numpy.load(payload)
        for part, value in loaded.items():
            _require_plain(part, value)
        if len(loaded) > _MOST_ARRAYS:
            raise DamagedFileError("its head has too many arrays")
        sizes = {part: len(loaded[part]) for part in ("v_template", "uv", "faces")}
        if max(sizes["v_template"], sizes["uv"]) > _MOST_VERTICES or sizes["faces"] > _MOST_FACES:
            raise DamagedFileError("its head has too many vertices or faces")
        state = {part: torch.from_numpy(value.copy()) for part, value in loaded.items()}
        arrays = HeadArrays.from_state({**state, **fields, "name": name})
        _require_surface(arrays)
        model = HeadModel(arrays)
        theta = torch.zeros(2, model.layout.size)
        theta[1] = 0.1
        for person in (identity, torch.ones(model.num_identity)):
            if not bool((model(theta, person).abs() <= _FARTHEST_M).all()):
                raise DamagedFileError(f"its head reaches beyond {_FARTHEST_M:g} m")
        return arrays


def _require_plain(name: str, value: Shaped[np.ndarray, "..."]) -> None:
    indices = name in _INDICES or name.startswith(_GROUP)
    if value.dtype.kind != ("i" if indices else "f"):
        raise DamagedFileError(f"{name[:40]} of its head holds {value.dtype}")
    if name.startswith(_GROUP) and value.ndim != 1:
        raise DamagedFileError(f"{name[:40]} of its head is no list")
    if not (indices or np.isfinite(value).all()):
        raise DamagedFileError(f"{name[:40]} of its head is not finite")


def _require_surface(arrays: HeadArrays) -> None:
    """Refuse what has no surface, and a UV map that would cover each texel over and over."""
    uv, faces = torch.from_numpy(arrays.uv).double(), torch.from_numpy(arrays.uv_faces).long()
    corners = uv[faces].clamp(-1, 2)
    covered = (corners.amax(1) - corners.amin(1)).prod(-1).sum() if len(faces) else 0.0
    if float(covered) > _MOST_UV_AREA:
        raise DamagedFileError("its head's UV map overlaps itself many times")
    if not len(faces) or not len(uv_anchors(uv, faces, _TRIED_RESOLUTION).triangle_index):
        raise DamagedFileError("its head has no surface")
