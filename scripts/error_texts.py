"""The errors that a user can cause, read from the sources: each call that makes one, by its words.

What is put in where it happens (a path, a number) is written as "…".
"""

import ast
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

GAP = "…"
PLACE_OF_CAUSE = {
    "UserError": 0,
    "DiskError": 0,
    "DamagedStageError": 0,
    "FlameVersionError": 0,
    "DeviceError": 0,
    "Problem": 2,
}
"""What is made of a cause and, after it, a remedy: which argument the cause is."""
REASONS = ("DamagedFileError", "RefusedPickleError", "UnusableFrameError", "MissingFileError")
"""Made of a reason, which an error of a user quotes."""


@dataclass(frozen=True)
class ErrorText:
    """What is said where an error is made."""

    kind: Literal["told", "reason", "warning"]
    """"told", of a cause and a remedy, "reason" or "warning"."""
    module: str
    """Path in the package, as `cli/render.py`."""
    line: int
    cause: str
    remedy: str
    """Empty where a cause stands alone; a lone gap where it is put together elsewhere."""


def error_texts(package: Path) -> list[ErrorText]:
    """All errors of a package, by module and line."""
    found = []
    for path in sorted(package.rglob("*.py")):
        tree = ast.parse(path.read_text())
        module = path.relative_to(package).as_posix()
        found += [text for text in _texts(tree, module) if text.cause.strip(f"{GAP} .")]
    return found


def _texts(tree: ast.Module, module: str) -> Iterator[ErrorText]:
    constants = _assigned(tree.body)
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    known_at: dict[int, dict[str, str]] = {}
    for function in functions:  # outer ones come first
        known = constants | _assigned(ast.walk(function))
        known_at |= {id(node): known for node in ast.walk(function)}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        known = known_at.get(id(node), constants)
        words = [_words(argument, known) for argument in node.args]
        first = PLACE_OF_CAUSE.get(name)
        if first is not None and len(words) >= first + 2:
            yield ErrorText("told", module, node.lineno, words[first], words[first + 1])
        elif name in REASONS and len(words) == 1:
            yield ErrorText("reason", module, node.lineno, words[0], "")
        elif name == "warnings.warn":
            yield ErrorText("warning", module, node.lineno, words[0], "")


def _assigned(statements: Sequence[ast.stmt] | Iterator[ast.AST]) -> dict[str, str]:
    """The texts that names stand for; the last one where a name has several."""
    texts: dict[str, str] = {}
    for statement in statements:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            words = _words(statement.value, texts)
            if words != GAP:
                texts[statement.targets[0].id] = words
    return texts


def _words(node: ast.expr, known: dict[str, str]) -> str:
    """The text of an expression, with a gap for each part that only running it would tell."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.Name):
        return known.get(node.id, GAP)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _words(node.left, known) + _words(node.right, known)
    if isinstance(node, ast.JoinedStr):
        parts = (_words(part, known) for part in node.values)
        return "".join(parts)
    if isinstance(node, ast.FormattedValue) and isinstance(node.value, ast.Name):
        return known.get(node.value.id, GAP)
    return GAP
