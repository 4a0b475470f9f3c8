"""FLAME from the user's own files: pickle, UV map and eyelids, as one head model."""

import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.flame_uv import FILE_NAMES, find_uv_file, make_uv_map, read_uv_map
from rgbavatar_ns.head.joints import EYES, LEFT_EYE, RIGHT_EYE
from rgbavatar_ns.head.safe_pickle import read_pickle
from rgbavatar_ns.head.teeth import TeethForm, with_teeth
from rgbavatar_ns.reading import DamagedFileError, load_array

FLAME_VARIABLE = "RGBAVATAR_FLAME"
FLAME_VERTICES, FLAME_TRIANGLES = 5023, 9976
IDENTITIES, EXPRESSIONS = 300, 100
VERSIONS = ("2017", "2019", "2020", "2023", "2023 Open")
_EYELIDS = ("l_eyelid.npy", "r_eyelid.npy")
COMPANIONS = (*FILE_NAMES, *_EYELIDS)
"""Files that add to a pickle what it lacks, where one of `places_beside` has them."""
_USUAL_NAMES = re.compile(r"(generic|male|female)_model|flame_(neutral|male|female)")
_SHAPES = {
    "v_template": (FLAME_VERTICES, 3),
    "shapedirs": (FLAME_VERTICES, 3, IDENTITIES + EXPRESSIONS),
    "posedirs": (FLAME_VERTICES, 3, 36),
    "J_regressor": (5, FLAME_VERTICES),
    "kintree_table": (2, 5),
    "weights": (FLAME_VERTICES, 5),
    "f": (FLAME_TRIANGLES, 3),
}
_GET_FLAME = (
    "FLAME may not be passed on, so get it yourself: register at https://flame.is.tue.mpg.de, "
    "download a version, and name its pickle or folder with --flame or the environment variable "
    f"{FLAME_VARIABLE}."
)


def load_flame(
    path: Path | None = None,
    *,
    uv: Path | None = None,
    eyelids: Path | None = None,
    teeth: bool = True,
    teeth_form: TeethForm = "strips",
    version: str | None = None,
    num_identity: int = IDENTITIES,
    num_expressions: int = EXPRESSIONS,
) -> HeadArrays:
    """FLAME 2017 to 2023 Open as a head model named after its version, such as "FLAME 2020".

    path: the pickle, or a folder that is searched for it; None takes RGBAVATAR_FLAME's.
    uv: npz or template OBJ; None looks beside the pickle, and else makes a map with a warning.
    eyelids: folder with l_eyelid.npy and r_eyelid.npy; None looks beside the pickle, and where
    they are absent the model has none.
    teeth, teeth_form: whether teeth are added and how (`head.teeth`).
    version: one of `VERSIONS`, which in a folder says which model is wanted; None reads it off the
    file's or its folder's name.
    num_identity, num_expressions: how many directions are kept, from the first.
    Raises UserError where something is missing, damaged or of another form.
    """
    if version is not None and version not in VERSIONS:
        raise UserError(f"There is no FLAME {version}.", f"Known are {', '.join(VERSIONS)}.")
    for name, count, most in (
        ("num_identity", num_identity, IDENTITIES),
        ("num_expressions", num_expressions, EXPRESSIONS),
    ):
        if not 1 <= count <= most:
            raise UserError(f"{name} is {count}.", f"FLAME has from 1 to {most}.")
    pickle_path = _find_pickle(_given_path(path), version)
    parts = _read_parts(pickle_path)
    name = f"FLAME {version or _version_of(pickle_path)}{_gender_of(pickle_path)}"
    places = places_beside(pickle_path)
    faces = parts["f"].astype(np.int64)
    kept = np.r_[:num_identity, IDENTITIES : IDENTITIES + num_expressions]
    weights = parts["weights"].astype(np.float32)
    uv_coordinates, uv_faces = _uv_map(uv, places, parts["v_template"], faces, name)
    arrays = HeadArrays(
        name=name,
        v_template=parts["v_template"].astype(np.float32),
        shapedirs=parts["shapedirs"][..., kept].astype(np.float32),
        num_identity=num_identity,
        posedirs=parts["posedirs"].astype(np.float32),
        joint_regressor=parts["J_regressor"].astype(np.float32),
        parents=_parents(pickle_path, parts["kintree_table"]),
        skinning_weights=weights,
        faces=faces,
        uv=uv_coordinates.astype(np.float32),
        uv_faces=uv_faces,
        expression_names=tuple(f"expression_{i}" for i in range(num_expressions)),
        eyelid_dirs=_eyelid_dirs(eyelids, places),
        vertex_groups={
            "skin": np.flatnonzero(weights[:, EYES].max(1) <= 0.5),
            "left_eye": np.flatnonzero(weights[:, LEFT_EYE] > 0.5),
            "right_eye": np.flatnonzero(weights[:, RIGHT_EYE] > 0.5),
        },
    )
    return with_teeth(arrays, teeth_form) if teeth else arrays


def places_beside(pickle_path: Path) -> list[Path]:
    """Where a pickle's `COMPANIONS` are looked for, in this order."""
    return [pickle_path.parent, pickle_path.parent.parent]


def _given_path(path: Path | None) -> Path:
    if path is None:
        named = os.environ.get(FLAME_VARIABLE)
        if not named:
            raise UserError("A FLAME model is needed, and none is named.", _GET_FLAME)
        path = Path(named)
    path = Path(path).expanduser()
    if not os.path.exists(path):
        raise UserError(f"There is no FLAME model at {path}.", _GET_FLAME)
    return path


def _find_pickle(path: Path, version: str | None) -> Path:
    """The pickle itself, or the only suitable one in the folder or two levels below it."""
    if not path.is_dir():
        return path
    found = sorted(
        candidate
        for pattern in ("*.pkl", "*/*.pkl", "*/*/*.pkl")
        for candidate in path.glob(pattern)
        if "flame" in candidate.name.lower() or _USUAL_NAMES.search(candidate.name.lower())
    )
    found = [candidate for candidate in found if not re.search("mask|embedding", candidate.name)]
    if version is not None:
        found = [candidate for candidate in found if _version_of(candidate, version) == version]
    # FLAME 2023 comes with and without jaw rotation in its shapes; trackers use the first.
    usual = [c for c in found if not _gender_of(c) and "no_jaw" not in c.name.lower()]
    found = usual or found
    if not found:
        wanted = f"FLAME {version}" if version else "FLAME"
        raise UserError(f"The folder {path} holds no pickle of {wanted}.", _GET_FLAME)
    if len(found) > 1:
        names = ", ".join(str(candidate.relative_to(path)) for candidate in found[:5])
        raise UserError(
            f"The folder {path} holds several FLAME models: {names}.",
            "Name the pickle that the data was tracked with.",
        )
    return found[0]


def stated_version(path: Path) -> str | None:
    """What the file's name says, then its folders', nearest first; None where none says it."""
    for name in (path.name, path.parent.name, path.parent.parent.name):
        year = re.search(r"20(16|17|19|20|23)(?!\d)", name)
        if "flame" in name.lower() and year:
            found = {"2016": "2017"}.get(year[0], year[0])
            is_open = found == "2023" and "open" in name.lower()
            return f"{found} Open" if is_open else found
    return None


def _version_of(path: Path, otherwise: str | None = None) -> str:
    stated = stated_version(path)
    if stated is not None:
        return stated
    if _USUAL_NAMES.search(path.name.lower()):
        # FLAME 2017 and 2020 name their files alike; 2020 is what today's trackers use.
        return "2020"
    if otherwise is not None:
        return otherwise
    raise UserError(
        f"The name {path.name} does not say which version of FLAME this is.",
        "Coefficients mean something else in each: rename it, for example to flame2023.pkl.",
    )


def _gender_of(path: Path) -> str:
    name = path.name.lower()
    return " female" if "female" in name else " male" if "male" in name else ""


def _read_parts(path: Path) -> dict[str, np.ndarray]:
    """FLAME's arrays, checked for shape and numbers."""
    model = read_pickle(path)
    if not isinstance(model, dict):
        raise UserError(f"{path} holds no FLAME model, but a {type(model).__name__}.", _GET_FLAME)
    missing = [name for name in _SHAPES if name not in model]
    if missing:
        raise UserError(f"{path} is no FLAME model: it lacks {', '.join(missing)}.", _GET_FLAME)
    parts = {}
    for name, shape in _SHAPES.items():
        value: Any = model[name]
        if getattr(value, "shape", None) != shape:
            raise UserError(
                f"{path} is no FLAME model: {name} has the shape "
                f"{getattr(value, 'shape', None)}, not {shape}.",
                _GET_FLAME,
            )
        value = value.toarray() if scipy.sparse.issparse(value) else np.asarray(value)
        if value.dtype.kind not in "biuf" or not np.isfinite(value).all():
            raise UserError(f"{path} is damaged: {name} holds no finite numbers.", _GET_FLAME)
        parts[name] = value
    return parts


def _parents(path: Path, kintree: np.ndarray) -> np.ndarray:
    parents = kintree[0].astype(np.int64)
    # The root's parent is written as 2^32 - 1.
    parents = np.where((parents < 0) | (parents >= 5), -1, parents)
    if parents.tolist() != [-1, 0, 1, 1, 1]:
        raise UserError(f"{path} has the joints {parents.tolist()}, not FLAME's.", _GET_FLAME)
    return parents


def _uv_map(
    uv: Path | None, places: list[Path], v_template: np.ndarray, faces: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray]:
    file = Path(uv) if uv is not None else find_uv_file(places)
    if file is not None:
        return read_uv_map(file, faces)
    warnings.warn(
        f"No UV map lies beside {name} (head_template.obj or FLAME_texture.npz); one is made "
        "anew, which serves as well but is not the one that others use.",
        stacklevel=3,
    )
    return make_uv_map(v_template, faces)


def _eyelid_dirs(folder: Path | None, places: list[Path]) -> np.ndarray | None:
    """Left and right eyelid offsets [V, 3, 2], where both files are found."""
    if folder is not None:
        places = [Path(folder)]
    for place in places:
        files = [place / name for name in _EYELIDS]
        if all(map(os.path.isfile, files)):
            return np.stack([_read_eyelid(file) for file in files], -1)
    if folder is not None:
        raise UserError(f"The folder {folder} lacks {' or '.join(_EYELIDS)}.", "Name another one.")
    return None


def _read_eyelid(path: Path) -> np.ndarray:
    try:
        offsets = load_array(path)
        if offsets.dtype.kind != "f" or offsets.size != FLAME_VERTICES * 3:
            raise DamagedFileError(f"it holds {offsets.dtype} of shape {offsets.shape}")
        if not np.isfinite(offsets).all():
            raise DamagedFileError("it holds NaN or infinity")
        return offsets.astype(np.float32).reshape(FLAME_VERTICES, 3)
    except DamagedFileError as error:
        raise UserError(
            f"{path} holds no eyelid offsets of {FLAME_VERTICES} vertices: {error}.",
            "Take it from metrical-tracker again, or remove it.",
        ) from None
