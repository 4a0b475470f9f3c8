"""Files of FLAME's form without FLAME's data, for trying and testing what reads FLAME.

The pickle is written as Python 2 wrote FLAME's: protocol 2, array bytes as text, scipy.sparse and
(if wanted) chumpy objects; the shapes, types and keys are FLAME's. The head in it is the embedded
CC0 one, cut to FLAME's 5,023 vertices and 9,976 triangles.
"""

import struct
from pathlib import Path

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int, Shaped

from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.flame import EXPRESSIONS, FLAME_TRIANGLES, FLAME_VERTICES, IDENTITIES
from rgbavatar_ns.head.landmarks import facemesh_landmarks
from rgbavatar_ns.head.teeth import LOWER_LIP, UPPER_LIP

FILE_NAMES = {
    "2017": "FLAME2017/generic_model.pkl",
    "2020": "FLAME2020/generic_model.pkl",
    "2023": "FLAME2023/flame2023.pkl",
    "2023 Open": "FLAME2023/flame2023_Open.pkl",
}
_UPPER_FACEMESH = (291, 409, 270, 269, 267, 0, 37, 39, 40, 185, 61)
_LOWER_FACEMESH = (291, 375, 321, 405, 314, 17, 84, 181, 91, 146, 61)
_UNMAPPED_TRIANGLES = 60
_UV_HEIGHT = 0.95
"""Above it FLAME's map is empty, where teeth go."""
_IDENTITY_M, _EXPRESSION_M = 1.5e-3, 1e-3
"""How far the first made-up identity and expression move the skin; later ones move less."""


def write_synthetic_flame(folder: Path, version: str = "2020", chumpy: bool = True) -> Path:
    """Write pickle, head_template.obj and eyelid offsets as their owners name them.

    chumpy: whether some arrays are chumpy objects, as in FLAME 2017 and 2020. The versions have
    the same template and other expressions. Returns the pickle's path; always the same files.
    """
    head = _flame_sized(HeadArrays.embedded())
    path = Path(folder) / FILE_NAMES[version]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_model_pickle(head, _directions(head, version), chumpy))
    (path.parent / "head_template.obj").write_text(_obj(head), encoding="ascii")
    x = head.v_template[:, :1]
    for side, own, name in (("Left", x > 0, "l_eyelid.npy"), ("Right", x < 0, "r_eyelid.npy")):
        blink = head.expression_names.index(f"eyeBlink{side}") + head.num_identity
        np.save(path.parent / name, (head.shapedirs[..., blink] * own).astype(np.float32))
    return path


def _flame_sized(head: HeadArrays) -> HeadArrays:
    """The head without teeth, tongue and neck's rim, FLAME's lip vertices at FLAME's numbers."""
    outside = np.zeros(len(head.v_template), dtype=bool)
    for group in ("upper_teeth", "lower_teeth", "tongue"):
        outside[head.vertex_groups[group]] = True
    height = np.where(outside, np.inf, head.v_template[:, 1])
    outside[np.argsort(height, kind="stable")[: (~outside).sum() - FLAME_VERTICES]] = True
    inside = np.flatnonzero(~outside)
    order = _with_lips_in_place(head, inside)
    number = np.full(len(outside), -1)
    number[order] = np.arange(len(order))
    kept = (number[head.faces] >= 0).all(1)
    triangles = _flame_many(head, np.flatnonzero(kept))
    uv_faces = head.uv_faces[triangles].copy()
    uv_faces[:_UNMAPPED_TRIANGLES] = uv_faces[:_UNMAPPED_TRIANGLES, :1]
    regressor = head.joint_regressor[:, order].astype(np.float64)
    return HeadArrays(
        name="synthetic",
        v_template=head.v_template[order],
        shapedirs=head.shapedirs[order],
        num_identity=head.num_identity,
        posedirs=head.posedirs[order],
        joint_regressor=regressor / regressor.sum(1, keepdims=True),
        parents=head.parents,
        skinning_weights=head.skinning_weights[order],
        faces=number[head.faces[triangles]],
        uv=head.uv * np.array([1, _UV_HEIGHT], head.uv.dtype),
        uv_faces=uv_faces,
        expression_names=head.expression_names,
    )


def _flame_many(head: HeadArrays, triangles: Int[np.ndarray, "F"]) -> Int[np.ndarray, "G"]:
    """FLAME's number of triangles: the lowest go, but none that a vertex needs."""
    uses = np.bincount(head.faces[triangles].ravel())
    low = np.argsort(head.v_template[head.faces[triangles]][..., 1].sum(1), kind="stable")
    dropped: list[int] = []
    for place in low:
        corners = head.faces[triangles[place]]
        if len(triangles) - len(dropped) > FLAME_TRIANGLES and (uses[corners] > 1).all():
            uses[corners] -= 1
            dropped.append(place)
    return np.delete(triangles, dropped)


def _with_lips_in_place(head: HeadArrays, inside: Int[np.ndarray, "V"]) -> Int[np.ndarray, "V"]:
    """The vertices' order, so that the lips' outlines have the numbers that they have in FLAME."""
    marks = facemesh_landmarks()
    corners = head.v_template[head.faces[marks.triangle]]
    points = dict(zip(marks.facemesh_index.tolist(), zip(marks.barycentric, corners)))
    order = inside.copy()
    taken: set[int] = set()
    for numbers, landmarks in ((UPPER_LIP, _UPPER_FACEMESH), (LOWER_LIP, _LOWER_FACEMESH)):
        line = np.stack([weights @ place for weights, place in (points[i] for i in landmarks)])
        along = np.linspace(0.5, len(line) - 1.5, len(numbers))
        outline = np.stack([np.interp(along, np.arange(len(line)), c) for c in line.T], 1)
        for number, place in zip(numbers, outline):
            far = np.linalg.norm(head.v_template[order] - place, axis=1)
            far[list(taken)] = np.inf
            found = int(far.argmin())
            order[[number, found]] = order[[found, number]]
            taken.add(number)
    return order


def _directions(head: HeadArrays, version: str) -> Float[np.ndarray, "V 3 400"]:
    """The head's own directions first, then smooth made-up ones that fade with their number."""
    directions = np.zeros((len(head.v_template), 3, IDENTITIES + EXPRESSIONS))
    identities, expressions = np.split(head.shapedirs, [head.num_identity], axis=2)
    # In FLAME an expression has no name, and the versions' bases have nothing in common.
    turned = expressions[..., np.roll(np.arange(expressions.shape[2]), int(version[:4]) % 7)]
    for start, known, total, size_m in (
        (0, identities, IDENTITIES, _IDENTITY_M),
        (IDENTITIES, turned, EXPRESSIONS, _EXPRESSION_M),
    ):
        count = known.shape[2]
        directions[..., start : start + count] = known
        generator = np.random.default_rng([start, int(version[:4]) if start else 0])
        for later in range(count, total):
            wave = generator.normal(0, 25, (3, 3)) @ head.v_template.T + generator.uniform(0, 6)
            directions[..., start + later] = size_m / (later - count + 1) * np.sin(wave).T
    return directions


def _obj(head: HeadArrays) -> str:
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in head.v_template]
    lines += [f"vt {u:.7f} {v:.7f}" for u, v in head.uv]
    for corners, coordinates in zip(head.faces + 1, head.uv_faces + 1):
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in zip(corners, coordinates)))
    return "\n".join(lines) + "\n"


def _model_pickle(head: HeadArrays, directions: np.ndarray, chumpy: bool) -> bytes:
    parents = np.stack([head.parents, np.arange(5)]).astype(np.uint32)
    template = head.v_template.astype(np.float64)
    numbers = {
        "v_template": template,
        "shapedirs": directions,
        "posedirs": np.zeros((*template.shape, 36)),
        "kintree_table": parents,
        "weights": head.skinning_weights.astype(np.float64),
        "f": head.faces.astype(np.uint32),
        "J": head.joint_regressor @ template,
    }
    in_chumpy = ("v_template", "shapedirs") if chumpy else ()
    parts = [b"\x80\x02}("]
    for name, array in numbers.items():
        parts += [_text(name), _chumpy(array) if name in in_chumpy else _array(array)]
    parts += [_text("J_regressor"), _sparse(head.joint_regressor)]
    for name, value in (("bs_style", "lbs"), ("bs_type", "lrotmin")):
        parts += [_text(name), _text(value)]
    return b"".join([*parts, b"u."])


# What Python 2's pickle, protocol 2, wrote (the opcodes are described in pickletools).


def _text(value: str) -> bytes:
    return b"U" + bytes([len(value)]) + value.encode("ascii")


def _integer(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def _tuple(*parts: bytes) -> bytes:
    return b"(" + b"".join(parts) + b"t"


def _array(array: Shaped[np.ndarray, "..."]) -> bytes:
    """numpy.ndarray by name, then version, shape, type, order and bytes as its state."""
    array = np.ascontiguousarray(array)
    made = b"cnumpy.core.multiarray\n_reconstruct\n" + _tuple(
        b"cnumpy\nndarray\n", _tuple(_integer(0)), _text("b")
    )
    minus = _integer(-1)
    numbers = b"cnumpy\ndtype\n" + _tuple(_text(array.dtype.str[1:]), _integer(0), _integer(1))
    order = _tuple(_integer(3), _text("<"), b"NNN", minus, minus, _integer(0))
    shape = _tuple(*map(_integer, array.shape))
    raw = array.tobytes()
    state = _tuple(
        _integer(1), shape, numbers + b"R" + order + b"b", b"\x89",
        b"T" + struct.pack("<i", len(raw)) + raw,
    )  # fmt: skip
    return made + b"R" + state + b"b"


def _object(name: bytes, state: bytes) -> bytes:
    made = _tuple(name, b"c__builtin__\nobject\n", b"N")
    return b"ccopy_reg\n_reconstructor\n" + made + b"R}(" + state + b"ub"


def _chumpy(array: Shaped[np.ndarray, "..."]) -> bytes:
    return _object(b"cchumpy.ch\nCh\n", _text("x") + _array(array))


def _sparse(matrix: Float[np.ndarray, "R C"]) -> bytes:
    columns = scipy.sparse.csc_matrix(matrix)
    state = _text("_shape") + _tuple(*map(_integer, matrix.shape))
    state += _text("format") + _text("csc") + _text("maxprint") + _integer(50)
    for name in ("data", "indices", "indptr"):
        state += _text(name) + _array(getattr(columns, name))
    return _object(b"cscipy.sparse.csc\ncsc_matrix\n", state)
