"""A bundle's head model by reference, for models that may not be passed on (FLAME)."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.flame import FLAME_VARIABLE, FLAME_VERTICES, VERSIONS, load_flame
from rgbavatar_ns.head.teeth import TeethForm
from rgbavatar_ns.reading import DamagedFileError, damage_told

HEAD_VARIABLE = "RGBAVATAR_HEAD"
"""Environment variable: the head model's file for bundles that only name it."""

_MARK = "reference"
_NUMBERS = ("num_identity", "num_expressions", "num_vertices")
_KINDS = {"name": str, "sha256": str, **dict.fromkeys(_NUMBERS, int)}


def reference_to(arrays: HeadArrays) -> dict[str, Any]:
    """Name, sizes and digest in place of a head model's arrays."""
    described = {
        "name": arrays.name,
        "num_identity": arrays.num_identity,
        "num_expressions": arrays.num_expressions,
        "num_vertices": len(arrays.v_template),
        "sha256": arrays.digest(),
    }
    return {_MARK: described}


def is_reference(state: Any) -> bool:
    """Whether a head's state only names it."""
    return isinstance(state, dict) and set(state) == {_MARK}


def resolve(state: dict[str, Any], bundle: Path) -> dict[str, Any]:
    """The state of the head that a reference names: the embedded one, or the user's own file.

    The file is RGBAVATAR_HEAD (written by HeadArrays.save) or, for FLAME, RGBAVATAR_FLAME. Raises
    UserError where none is named, it cannot be read, or it holds another head; DamagedFileError
    for a reference that is none.
    """
    described = state[_MARK]
    with damage_told():
        kinds = {key: type(value) for key, value in described.items()}
    if kinds != _KINDS:
        raise DamagedFileError("its reference to a head model is none")
    name = described["name"]
    found: list[str] = []
    for arrays in _candidates(described):
        if arrays.digest() == described["sha256"]:
            return arrays.to_state()
        found.append(arrays.name)
    remedy = (
        f"Set {HEAD_VARIABLE} to its file (written by HeadArrays.save), or for FLAME "
        f"{FLAME_VARIABLE} to the pickle, of the same version"
    )
    if found:
        raise UserError(
            f"The head model '{found[0]}' found here is not the '{name}' that the avatar bundle "
            f"{bundle} was made with.",
            f"{remedy}.",
        )
    raise UserError(
        f"The avatar bundle {bundle} does not hold its head model '{name}', only its name.",
        f"{remedy}; or ask for a bundle that holds it.",
    )


def _candidates(described: dict[str, Any]) -> Iterator[HeadArrays]:
    """Heads of this name on this machine; only its digest says whether one is the same."""
    name = described["name"]
    file = os.environ.get(HEAD_VARIABLE)
    if file:
        yield HeadArrays.load(Path(file))
    embedded = HeadArrays.embedded_as(name)
    if embedded is not None:
        yield embedded
    versions = [version for version in VERSIONS if name.startswith(f"FLAME {version}")]
    if versions and os.environ.get(FLAME_VARIABLE):
        for form in get_args(TeethForm):
            yield load_flame(
                teeth=described["num_vertices"] > FLAME_VERTICES,
                teeth_form=form,
                version=max(versions, key=len),
                num_identity=described["num_identity"],
                num_expressions=described["num_expressions"],
            )
