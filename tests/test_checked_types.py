"""The tests' own checks of types and shapes see what they are there for."""

import importlib
from pathlib import Path

import jaxtyping
import pytest
import torch
from jaxtyping import Float, TypeCheckError
from torch import Tensor

from tests import checked_types
from tests.checked_types import checked


def _added(a: Float[Tensor, "N 3"], b: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    return (a + b).sum(-1)


def _returned(a: Float[Tensor, "N 3"], out: Tensor) -> Float[Tensor, "N"]:
    return out


def _named(path: Path, count: int = 1, *, text: str | None = None) -> str:
    return f"{path}{count}{text}"


def _unknown(a: "NobodyKnows", count: int) -> int:  # pyright: ignore
    return count


def test_shapes_of_two_arguments_are_compared():
    add = checked(_added)
    assert add(torch.zeros(2, 3), torch.ones(2, 3)).tolist() == [3, 3]
    with pytest.raises(TypeCheckError):
        add(torch.zeros(2, 3), torch.zeros(4, 3))
    with pytest.raises(TypeCheckError):
        add(torch.zeros(2, 3), torch.zeros(2, 3, dtype=torch.int32))
    add(torch.zeros(4, 3), torch.zeros(4, 3))  # a call remembers nothing of another


def test_what_is_returned_is_compared_with_what_was_passed():
    give = checked(_returned)
    give(torch.zeros(2, 3), torch.zeros(2))
    with pytest.raises(TypeCheckError):
        give(torch.zeros(2, 3), torch.zeros(3))


def test_plain_types_are_checked_and_unknown_names_are_not():
    name = checked(_named)
    assert name(Path("a"), text="b") == "a1b"
    for wrong in (lambda: name("a"), lambda: name(Path("a"), 1.5), lambda: name(Path(), text=3)):
        with pytest.raises(TypeCheckError):
            wrong()
    assert checked(_unknown)(object(), 3) == 3
    with pytest.raises(TypeCheckError):
        checked(_unknown)(object(), "3")


@pytest.mark.usefixtures("unchecked_types")
def test_a_test_may_go_without():
    assert checked(_named)("a", 2) == "a2None"


def test_the_import_hook_checks_a_module_by_it(tmp_path, monkeypatch):
    (tmp_path / "hooked_module.py").write_text(
        "def twice(count: int) -> int:\n    return 2 * count\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with jaxtyping.install_import_hook("hooked_module", "beartype.beartype"):
        module = importlib.import_module("hooked_module")
    assert module.twice.__code__.co_filename == checked_types.__file__
    assert module.twice(3) == 6
    with pytest.raises(TypeCheckError):
        module.twice("3")
