"""An avatar's Gaussians and weight network as a page wants them: whole numbers in columns."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.model.blendshapes import COLOR_SCALE
from rgbavatar_ns.export.seen_order import SeenOrder
from rgbavatar_ns.export.stored_array import StoredArray, exact, ranged, stepped

_PLACE_STEP, _BASIS_PLACE_STEP = 0.01, 0.02
"""Of a middling Gaussian's size. Coarser bases would change which of two Gaussians is before the
other: the picture would fall below 45 dB where psi is large."""
_TURN_STEP = 0.01
"""Of a middling quaternion's length: half a degree."""
_COLOR_STEP = 0.5 / 255 / COLOR_SCALE
"""Of a colour's feature: half of a picture's step."""
_LEAST_PSI = 0.05
"""The page's sliders reach twice as far, whatever the film called for."""
_LEAST_WEIGHT = 1e-2
"""Of the mean; what is not seen at all still has a logarithm."""
_NETWORK_STEPS = 1024
"""To the largest weight of each of a layer's inputs."""

Arrays = dict[str, StoredArray]


def gaussian_arrays(avatar: Avatar, seen: SeenOrder, psi: Float[np.ndarray, "K"]) -> Arrays:
    """The Gaussians, in the avatar's order; columns of bases are psi's k first, then components.

    seen: as `seen_order` of this avatar gives it. psi: the largest magnitude of each weight that
    the film calls for; a basis is rounded to where psi times its error is the base's.
    """
    shapes, mesh = avatar.blendshapes, avatar.anchors.triangles(with_rest_length=False)
    few = len(mesh["triangle_vertices"]) <= 1 << 16
    place = _place_step(avatar)
    turn = np.full(4, _TURN_STEP * _middle(shapes.rotation_wxyz.norm(dim=1)))
    color = np.full(3, _COLOR_STEP)
    weight = _numpy(seen.weight).astype(np.float64)
    weight += max(_LEAST_WEIGHT * weight.mean(), np.finfo(np.float32).tiny)
    of_cell = np.bincount(_numpy(seen.cell), weight)
    size = torch.cat([shapes.log_scale.exp(), shapes.opacity_logit.sigmoid()[:, None]], 1)
    arrays = {
        "triangle_of": exact(_numpy(mesh["triangle_of"]), "uint16" if few else "uint32", "uint32"),
        "barycentric": ranged(_columns(avatar.anchors.barycentric[:, :2])),
        "position": stepped(_columns(shapes.position), place, by_item=False),
        "rotation": stepped(_columns(shapes.rotation_wxyz), turn),
        "scale": ranged(_columns(size[:, :3]), logarithmic=True),
        "opacity": ranged(_columns(size[:, 3:])),
        "color": stepped(_columns(shapes.color_feature), color),
        "cell": exact(_numpy(seen.cell), "uint16", "uint32"),
        "weight": ranged(weight[None], logarithmic=True),
        "cell_weight": ranged(of_cell[None], "uint16", logarithmic=True),
    }
    if avatar.config.num_bases > 0:
        reached = np.maximum(psi, _LEAST_PSI)
        for name, bases, step in (
            ("basis_position", shapes.basis_position, place * (_BASIS_PLACE_STEP / _PLACE_STEP)),
            ("basis_rotation", shapes.basis_rotation_wxyz, turn),
            ("basis_color", shapes.basis_color_feature, color),
        ):
            columns = _numpy(bases).transpose(0, 2, 1).reshape(-1, avatar.num_gaussians)
            steps = (step / reached[:, None]).reshape(-1)
            arrays[name] = stepped(columns, steps, "int8", "int8", by_item=False)
    return arrays


def network_arrays(avatar: Avatar) -> tuple[list[dict[str, int]], Arrays]:
    """Sizes of the weight network's layers; their matrices and biases, and what training saw."""
    layers: list[dict[str, int]] = []
    arrays: Arrays = {
        "theta_low": exact(_numpy(avatar.theta_low), "float32"),
        "theta_high": exact(_numpy(avatar.theta_high), "float32"),
    }
    linear = [] if avatar.weight_network is None else avatar.weight_network.layers
    for layer in linear:
        if isinstance(layer, torch.nn.Linear):
            place, matrix = len(layers), _columns(layer.weight)
            step = np.abs(matrix).max(1, initial=0) / _NETWORK_STEPS
            arrays[f"network_matrix_{place}"] = stepped(matrix, np.maximum(step, 1e-12))
            arrays[f"network_bias_{place}"] = exact(_numpy(layer.bias), "float32")
            layers.append({"inputs": layer.in_features, "outputs": layer.out_features})
    return layers, arrays


@torch.no_grad()
def _place_step(avatar: Avatar) -> Float[np.ndarray, "3"]:
    """Of positions in tangent frames, whose columns may be metres a unit of UV."""
    rest = avatar.identity.new_zeros(1, avatar.layout.size)
    frames = avatar.anchors.frames(avatar.carrier_vertices(rest)).matrix[0]
    size = _middle(avatar.blendshapes.log_scale.exp())
    return _PLACE_STEP * size / frames.norm(dim=1).mean(0).cpu().numpy().astype(np.float64)


def _middle(values: Float[Tensor, "..."]) -> float:
    return float(values.detach().median())


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()


def _columns(rows: Float[Tensor, "N C"]) -> Float[np.ndarray, "C N"]:
    return _numpy(rows).T
