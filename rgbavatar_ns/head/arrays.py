"""A head model as plain arrays in FLAME's convention, and their file."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float16, Int
from torch import Tensor

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import atomic_write, digest
from rgbavatar_ns.reading import DamagedFileError, load_arrays

TEETH, TONGUE = ("upper_teeth", "lower_teeth"), "tongue"
"""Names of vertex groups."""
NECK_SHIFTS = ("neckLeft", "neckUp", "neckForward")
"""Expressions of a bust that carry the head along the torso's x, y and z, in centimetres, as the
neck does without a turn of its one joint."""
EMBEDDED_HEAD, EMBEDDED_BUST = "makehuman", "makehuman_bust"
"""Names of the CC0 heads that ship with the package: one ends at the neck, the other one has
shoulders and chest too. Their first vertices, triangles and expressions are the same."""
BODY_IDENTITY = ("shoulders up", "shoulders wide")
"""What a bust's last identity directions do to it, in centimetres; the others are the head's."""
_EMBEDDED = {EMBEDDED_HEAD: "makehuman_head.npz", EMBEDDED_BUST: "makehuman_bust.npz"}
_GROUP = "group_"
_MAY_BE_HALF = ("shapedirs", "posedirs", "eyelid_dirs")
_WHOLE_NUMBERS = ("parents", "faces", "uv_faces")
_MOST_ROWS, _MOST_DIRECTIONS, _LONGEST_NAME = 1 << 20, 4096, 200
_FARTHEST_M = 100.0


def embedded_file(name: str = EMBEDDED_HEAD) -> Path:
    """Where an embedded head lies; UserError for a name that none has."""
    if name not in _EMBEDDED:
        raise UserError(
            f"No head model of the name '{name[:_LONGEST_NAME]}' ships with this package.",
            f"It has {' and '.join(_EMBEDDED)}.",
        )
    return Path(__file__).parent / "assets" / _EMBEDDED[name]


@dataclass(frozen=True)
class HeadArrays:
    """FLAME and the embedded head differ only in these; raises UserError if they fit no head.

    Metres, y up, z forward, +x the subject's left; triangles are wound outward. Source: FLAME's
    model files; uv has u to the right and v up. Not to be written to: what follows from the arrays
    is found once.
    """

    name: str
    v_template: Float[np.ndarray, "V 3"]
    """The mean head at rest."""
    shapedirs: Float[np.ndarray, "V 3 C"]
    """Offsets a unit of coefficient: `num_identity` identity directions, then expressions."""
    num_identity: int
    posedirs: Float[np.ndarray, "V 3 36"]
    """Offsets a unit of (R - I), rows of neck, jaw, left eye, right eye after one another."""
    joint_regressor: Float[np.ndarray, "5 V"]
    """Joints from the shaped vertices; rows sum to one."""
    parents: Int[np.ndarray, "5"]
    """Parent joint of root, neck, jaw, left eye, right eye; -1 for the root."""
    skinning_weights: Float[np.ndarray, "V 5"]
    """Rows sum to one."""
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "VT 2"]
    uv_faces: Int[np.ndarray, "F 3"]
    expression_names: tuple[str, ...]
    """A name for each expression direction."""
    eyelid_dirs: Float[np.ndarray, "V 3 2"] | None = None
    """Offsets that close the left and the right eyelid, where the model has them."""
    vertex_groups: dict[str, Int[np.ndarray, "_"]] = field(default_factory=dict)
    """Vertices of skin, left_eye, right_eye, upper_teeth, lower_teeth, tongue, torso, if known."""

    def __post_init__(self) -> None:
        # Sums round by the order in memory: a head is the same before and after it was stored.
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                native = np.ascontiguousarray(value, value.dtype.newbyteorder("="))
                object.__setattr__(self, item.name, native)
        self._check_names()
        vertices = len(self.v_template)
        wanted: dict[str, tuple[int, ...]] = {
            "v_template": (vertices, 3),
            "shapedirs": (vertices, 3, self.num_identity + self.num_expressions),
            "posedirs": (vertices, 3, 36),
            "joint_regressor": (5, vertices),
            "parents": (5,),
            "skinning_weights": (vertices, 5),
            "faces": (len(self.faces), 3),
            "uv": (len(self.uv), 2),
            "uv_faces": (len(self.faces), 3),
        }
        if self.eyelid_dirs is not None:
            wanted["eyelid_dirs"] = (vertices, 3, 2)
        for name, shape in wanted.items():
            self._check_numbers(name, getattr(self, name), shape)
        parents = self.parents.tolist()
        if parents[0] != -1 or any(not 0 <= p < k for k, p in enumerate(parents[1:], 1)):
            raise self._refuse(f"its joints hang on {parents}, not each on an earlier one")
        for name, index, count in (
            ("faces", self.faces, vertices),
            ("uv_faces", self.uv_faces, len(self.uv)),
            *((name, group, vertices) for name, group in self.vertex_groups.items()),
        ):
            if index.ndim == 0 or index.dtype.kind not in "iu":
                raise self._refuse(f"{name} is no list of whole numbers")
            if index.size and (index.min() < 0 or index.max() >= count):
                raise self._refuse(f"{name} points outside of its {count} vertices")

    def _check_names(self) -> None:
        names = (self.name, *self.expression_names)
        if not all(isinstance(name, str) and len(name) <= _LONGEST_NAME for name in names):
            raise self._refuse("it has names that are no short text")
        if len(set(self.expression_names)) < len(self.expression_names):
            raise self._refuse("two of its expressions have one name")
        if not 0 <= self.num_identity <= _MOST_DIRECTIONS - self.num_expressions:
            raise self._refuse(f"it claims {self.num_identity} identity directions")

    def _check_numbers(self, name: str, value: Any, shape: tuple[int, ...]) -> None:
        kind = "i" if name in _WHOLE_NUMBERS else "f"
        if not isinstance(value, np.ndarray) or value.dtype.kind != kind or value.itemsize > 8:
            raise self._refuse(f"{name} is {getattr(value, 'dtype', 'no array')}")
        if value.shape != shape or max(shape) > _MOST_ROWS:
            raise self._refuse(f"{name} has shape {value.shape}, not {shape}")
        farthest = max(-value.min(), value.max()) if kind == "f" and value.size else 0.0
        if not farthest <= _FARTHEST_M:  # nor is NaN
            raise self._refuse(f"{name} holds NaN, or numbers beyond {_FARTHEST_M:g}")

    def _refuse(self, reason: str) -> UserError:
        return UserError(
            f"The head model '{str(self.name)[:_LONGEST_NAME]}' does not fit together: {reason}.",
            "Convert it again, or use the embedded head.",
        )

    @property
    def num_expressions(self) -> int:
        """How many expression directions follow the identity directions."""
        return len(self.expression_names)

    @property
    def has_torso(self) -> bool:
        """Whether the mesh goes on below the neck, where the root joint carries it."""
        return "torso" in self.vertex_groups

    def vertices_of(self, names: Iterable[str]) -> Int[np.ndarray, "_"]:
        """The vertices in any of those groups, by number; of a head without such groups none."""
        found = [np.asarray(self.vertex_groups.get(name, []), np.int64) for name in names]
        return np.unique(np.concatenate([*found, np.zeros(0, np.int64)]))

    @cached_property
    def flat_shapedirs(self) -> Float[np.ndarray, "C V3"]:
        """`shapedirs` as `flat_directions`, found once for all models that are made of these."""
        return flat_directions(self.shapedirs)

    @cached_property
    def joint_directions(self) -> Float[np.ndarray, "E 15"]:
        """How each expression moves the joints: all x, then all y, then all z; found once."""
        expressions = self.shapedirs[..., self.num_identity :].astype(np.float64)
        moved = np.einsum("jv,vcx->xcj", self.joint_regressor.astype(np.float64), expressions)
        return moved.reshape(len(moved), 15)

    @classmethod
    def embedded(cls, name: str = EMBEDDED_HEAD) -> "HeadArrays":
        """MakeHuman's head (assets/LICENSE), or its bust; UserError for another name."""
        return _load_embedded(name)

    @classmethod
    def embedded_as(cls, name: str) -> "HeadArrays | None":
        """The embedded head of this name, or None where there is none."""
        return cls.embedded(name) if name in _EMBEDDED else None

    def save(self, path: Path) -> None:
        """Write one npz without pickles; offsets go as float16 where that loses nothing.

        Nothing is compressed: FLAME's offsets, nearly all of it, would take three quarters of the
        room, and of an import's time the largest part.
        """
        arrays = {name: np.array(value) for name, value in self._items()}
        with atomic_write(Path(path)) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> "HeadArrays":
        """Read what `save` wrote; raises UserError for a missing or damaged file."""
        try:
            return cls._from_items(load_arrays(path))
        except (DamagedFileError, KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"{path} is no head model of this project: {error}.",
                "Write it with HeadArrays.save, or use the embedded head.",
            ) from None

    def to_state(self) -> dict[str, Any]:
        """The arrays as tensors, text and numbers, safe for `torch.load(weights_only=True)`."""
        state: dict[str, Any] = {}
        for name, value in self._items():
            state[name] = torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value
        return state

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "HeadArrays":
        """Inverse of `to_state`; raises UserError where something is missing."""
        try:
            return cls._from_items(
                {
                    name: value.detach().cpu().numpy() if isinstance(value, Tensor) else value
                    for name, value in state.items()
                }
            )
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"This state holds no head model: {error}.", "Save the avatar again."
            ) from None

    def digest(self) -> str:
        """SHA-256 of all arrays and names: what tells one head model from another."""
        return self._digest

    @cached_property
    def _digest(self) -> str:
        parts: list[str | np.ndarray] = []
        for name, value in sorted(self._items(), key=lambda item: item[0]):
            parts += [name, value if isinstance(value, np.ndarray) else repr(value)]
        return digest(parts)

    def _items(self) -> list[tuple[str, Any]]:
        """Flat names and values; nothing for absent eyelids."""
        items = []
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name == "vertex_groups":
                items += [(_GROUP + name, group) for name, group in value.items()]
            elif entry.name == "expression_names":
                items.append((entry.name, list(value)))
            elif value is not None:
                items.append((entry.name, self._halves.get(entry.name, value)))
        return items

    @cached_property
    def _halves(self) -> dict[str, Float16[np.ndarray, "V 3 _"]]:
        """Offsets that lose nothing as float16; found once, since writing and digests need it."""
        found = {}
        for name in _MAY_BE_HALF:
            value = getattr(self, name)
            if value is not None:
                half = value.astype(np.float16)
                if np.array_equal(half.astype(value.dtype), value):
                    found[name] = half
        return found

    @classmethod
    def _from_items(cls, items: Mapping[str, Any]) -> "HeadArrays":
        values = {name: value for name, value in items.items() if not name.startswith(_GROUP)}
        for name in _MAY_BE_HALF:
            if name in values and values[name].dtype == np.float16:
                values[name] = values[name].astype(np.float32)
        values["name"] = str(values["name"])
        values["num_identity"] = int(values["num_identity"])
        values["expression_names"] = tuple(str(name) for name in values["expression_names"])
        groups = {
            name.removeprefix(_GROUP): value
            for name, value in items.items()
            if name.startswith(_GROUP)
        }
        return cls(**values, vertex_groups=groups)


def flat_directions(directions: Float[np.ndarray, "V 3 C"]) -> Float[np.ndarray, "C V3"]:
    """Directions as rows over all x, then all y, then all z, for one matrix product."""
    num_vertices, _, count = directions.shape
    return np.ascontiguousarray(directions.transpose(2, 1, 0)).reshape(count, 3 * num_vertices)


@cache
def _load_embedded(name: str) -> HeadArrays:
    return HeadArrays.load(embedded_file(name))
