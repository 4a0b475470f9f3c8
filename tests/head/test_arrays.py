from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import HeadArrays
from tests.head.synthetic_head import flame_shaped_arrays


def assert_same(first: HeadArrays, second: HeadArrays) -> None:
    for field in fields(HeadArrays):
        mine, other = getattr(first, field.name), getattr(second, field.name)
        if isinstance(mine, np.ndarray):
            np.testing.assert_array_equal(mine, other, err_msg=field.name)
            assert mine.dtype == other.dtype, field.name
        elif isinstance(mine, dict):
            assert mine.keys() == other.keys()
            for name in mine:
                np.testing.assert_array_equal(mine[name], other[name])
        else:
            assert mine == other, field.name


@pytest.mark.parametrize("arrays", [flame_shaped_arrays(), HeadArrays.embedded()])
def test_arrays_survive_files_and_checkpoints(arrays: HeadArrays, tmp_path: Path) -> None:
    arrays.save(tmp_path / "head.npz")
    assert_same(HeadArrays.load(tmp_path / "head.npz"), arrays)
    torch.save(arrays.to_state(), tmp_path / "state.pt")
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    assert_same(HeadArrays.from_state(state), arrays)


def test_a_head_without_eyelids_comes_back_without() -> None:
    arrays = replace(flame_shaped_arrays(), eyelid_dirs=None)
    assert HeadArrays.from_state(arrays.to_state()).eyelid_dirs is None


def test_the_state_does_not_share_memory_with_the_arrays() -> None:
    arrays = flame_shaped_arrays()
    arrays.to_state()["v_template"].zero_()
    assert np.abs(arrays.v_template).max() > 0


def test_missing_and_damaged_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"nothing\.npz"):
        HeadArrays.load(tmp_path / "nothing.npz")
    flame_shaped_arrays().save(tmp_path / "head.npz")
    content = (tmp_path / "head.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(content[: len(content) // 2])
    np.savez(tmp_path / "other.npz", name=np.array("other"))
    for name in ("half", "other"):
        with pytest.raises(UserError, match=rf"{name}\.npz"):
            HeadArrays.load(tmp_path / f"{name}.npz")
    with pytest.raises(UserError):
        HeadArrays.from_state({"name": "other"})


@pytest.mark.parametrize(
    ("field", "changed", "told"),
    [
        ("v_template", lambda v: v * np.nan, "NaN"),
        ("shapedirs", lambda v: v + 1e6, "beyond 100"),
        ("uv", lambda v: np.where(v > 0, np.inf, v), "NaN, or numbers beyond"),
        ("posedirs", lambda v: v.astype(np.complex128), "holds no head|complex128"),
        ("joint_regressor", lambda v: v > 0, "holds no head|bool"),
        ("skinning_weights", lambda v: v.astype(str), "holds no head|<U"),
        ("faces", lambda v: v.astype(np.float32), "holds no head|float32"),
        ("uv_faces", lambda v: v.astype(np.uint64), "holds no head|uint64"),
        ("parents", lambda v: np.array([-1, 2, 1, 1, 1]), "hang on"),
        ("parents", lambda v: np.array([-1, 0, 1, 1, 99]), "hang on"),
        ("parents", lambda v: np.array([0, 0, 1, 1, 1]), "hang on"),
        ("num_identity", lambda v: -5, "claims -5"),
        ("num_identity", lambda v: 10**12, "claims 1000000000000"),
        ("expression_names", lambda v: v[:-1] + v[:1], "one name"),
        ("expression_names", lambda v: ("x" * 9999, *v[1:]), "short text"),
        ("group_skin", lambda v: np.array(["x"]), "holds no head|skin is no list"),
    ],
)
def test_what_is_no_head_is_refused(field, changed, told) -> None:
    arrays = flame_shaped_arrays()
    items = dict(arrays._items())
    with pytest.raises(UserError, match=told):
        HeadArrays.from_state({**items, field: changed(items[field])})


def test_the_other_byte_order_is_turned() -> None:
    arrays = flame_shaped_arrays()
    turned = replace(arrays, v_template=arrays.v_template.astype(">f8"))
    assert turned.digest() == arrays.digest()


def test_arrays_that_do_not_fit_together_are_refused() -> None:
    arrays = flame_shaped_arrays()
    with pytest.raises(UserError, match="shapedirs"):
        replace(arrays, expression_names=arrays.expression_names[:-1])
    with pytest.raises(UserError, match="faces"):
        replace(arrays, faces=arrays.faces + 1)
