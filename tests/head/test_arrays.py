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


def test_arrays_that_do_not_fit_together_are_refused() -> None:
    arrays = flame_shaped_arrays()
    with pytest.raises(UserError, match="shapedirs"):
        replace(arrays, expression_names=arrays.expression_names[:-1])
    with pytest.raises(UserError, match="faces"):
        replace(arrays, faces=arrays.faces + 1)
