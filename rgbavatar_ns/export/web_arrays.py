"""An avatar's numbers as the web page wants them: compact, flat, little-endian."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int8, Int16
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.head import HeadArrays

TEXTURE_WIDTH = 1024
"""Texels in a row of the page's textures."""

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Quantized:
    """Whole numbers times one unit for each column of the second axis."""

    values: Int8[np.ndarray, "K C N"] | Int16[np.ndarray, "K C N"]
    unit: Float[np.ndarray, "K C"]


def quantize(
    values: Float[np.ndarray, "K C N"], dtype: type[np.int8] | type[np.int16] = np.int8
) -> Quantized:
    """Round to the type's whole numbers, with the largest magnitude of each row at its limit.

    The error of a value is at most half of its row's unit.
    """
    limit = np.iinfo(dtype).max
    unit = np.abs(values).max(-1, initial=0) / limit
    safe = np.where(unit > 0, unit, 1)
    return Quantized(np.rint(values / safe[..., None]).astype(dtype), unit.astype(np.float32))


def head_arrays(avatar: Avatar) -> Arrays:
    """The person's neutral head, its offsets as sparse columns, joints and skinning."""
    arrays, head = avatar.head.arrays, avatar.head
    identity = avatar.identity.cpu().numpy().astype(np.float64)
    shapes = arrays.shapedirs.astype(np.float64)
    neutral = arrays.v_template + shapes[..., : arrays.num_identity] @ identity
    expressions = shapes[..., arrays.num_identity :]
    regressor = arrays.joint_regressor.astype(np.float64)
    columns = [expressions]
    if arrays.eyelid_dirs is not None:
        columns.append(arrays.eyelid_dirs)
    if arrays.posedirs.any():
        columns.append(arrays.posedirs)
    with torch.no_grad():
        joints = head.joints(avatar.identity).cpu().numpy()
    return {
        "neutral_vertices": neutral.astype(np.float32),
        "skinning_weights": arrays.skinning_weights.astype(np.float32),
        "joints": joints,
        "joint_directions": np.einsum("jv,vcx->xjc", regressor, expressions).astype(np.float32),
        **_sparse_columns(np.concatenate(columns, -1), arrays),
    }


def _sparse_columns(offsets: Float[np.ndarray, "V 3 C"], arrays: HeadArrays) -> Arrays:
    """Only the vertices that each column moves; offsets in 16 bits to a column's unit."""
    quantized = quantize(offsets.transpose(2, 1, 0).reshape(offsets.shape[2], 1, -1), np.int16)
    dense = quantized.values.reshape(-1, 3, len(offsets)).transpose(0, 2, 1)
    column, vertex = np.nonzero(dense.any(-1))
    start = np.searchsorted(column, np.arange(len(dense) + 1))
    few = len(arrays.v_template) <= np.iinfo(np.uint16).max
    return {
        "offset_start": start.astype(np.uint32),
        "offset_vertex": vertex.astype(np.uint16 if few else np.uint32),
        "offset_value": dense[column, vertex],
        "offset_unit": quantized.unit[:, 0],
    }


def gaussian_arrays(avatar: Avatar) -> Arrays:
    """Anchors and base in full, bases as signed bytes with a unit for each component."""
    shapes = avatar.blendshapes
    mesh = avatar.anchors.triangles(with_rest_length=True)
    number = _padded(mesh["triangle_of"][:, None].float())
    result = {
        "triangle_vertices": _numpy(mesh["triangle_vertices"]).astype(np.uint32),
        "edges_to_frame": _numpy(mesh["edges_to_frame"]),
        "rest_length": _numpy(mesh["rest_length"]),
        "triangle_of": _numpy(mesh["triangle_of"]).astype(np.uint32),
        "barycentric": _numpy(mesh["barycentric"]),
        "position": _numpy(shapes.position).T,
        "rotation": _padded(shapes.rotation_wxyz),
        "scale_opacity": _padded(
            torch.cat([shapes.log_scale.exp(), shapes.opacity_logit.sigmoid()[:, None]], 1)
        ),
        "color_triangle": np.concatenate([_padded(shapes.color_feature), number], 1),
    }
    if avatar.config.num_bases == 0:
        empty = np.zeros(0, np.float32)
        names = ("basis_position", "basis_rotation", "basis_color")
        return result | {name + end: empty for name in names for end in ("", "_unit")}
    position = quantize(_numpy(shapes.basis_position).transpose(0, 2, 1))
    result |= {"basis_position": position.values, "basis_position_unit": position.unit}
    for name, bases in (
        ("basis_rotation", shapes.basis_rotation_wxyz),
        ("basis_color", shapes.basis_color_feature),
    ):
        quantized = quantize(_numpy(bases).transpose(0, 2, 1))
        texels = _texels(quantized.values.transpose(0, 2, 1))
        result |= {name: texels, f"{name}_unit": quantized.unit}
    return result


def network_arrays(avatar: Avatar) -> tuple[list[dict[str, int]], Arrays]:
    """Sizes of the weight network's layers; their matrices and biases, and what training saw."""
    layers: list[dict[str, int]] = []
    arrays: Arrays = {
        "theta_low": _numpy(avatar.theta_low),
        "theta_high": _numpy(avatar.theta_high),
    }
    linear = [] if avatar.weight_network is None else avatar.weight_network.layers
    for layer in linear:
        if isinstance(layer, torch.nn.Linear):
            place = len(layers)
            arrays[f"network_matrix_{place}"] = _numpy(layer.weight)
            arrays[f"network_bias_{place}"] = _numpy(layer.bias)
            layers.append({"inputs": layer.in_features, "outputs": layer.out_features})
    return layers, arrays


def pack(arrays: Arrays) -> tuple[dict[str, dict[str, Any]], bytes]:
    """One block of bytes, each array at a multiple of four, and where each is."""
    directory: dict[str, dict[str, Any]] = {}
    block = bytearray()
    for name, values in arrays.items():
        little = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
        directory[name] = {"dtype": values.dtype.name, "offset": len(block), "length": values.size}
        block += little.tobytes()
        block += bytes(-len(block) % 4)
    return directory, bytes(block)


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _padded(rows: Float[Tensor, "N C"]) -> Float[np.ndarray, "T C"]:
    """Rows of numbers, filled up to whole rows of texels."""
    values = _numpy(rows).astype(np.float32)
    return np.pad(values, ((0, -len(values) % TEXTURE_WIDTH), (0, 0)))


def _texels(values: Int8[np.ndarray, "K N C"]) -> Int8[np.ndarray, "K T 4"]:
    """Four bytes a Gaussian, filled up to whole rows of texels."""
    _, count, components = values.shape
    return np.pad(values, ((0, 0), (0, -count % TEXTURE_WIDTH), (0, 4 - components)))
