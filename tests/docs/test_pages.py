"""The pages for users: links lead somewhere, commands and options are there, snippets compile."""

import ast
import contextlib
import io
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from rgbavatar_ns.cli.main import COMMANDS, main

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "configs/README.md"])
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]


def without_code(text: str) -> str:
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.S)


def anchors(page: Path) -> set[str]:
    """The names that GitHub gives a page's headings."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    titles = re.findall(r"^#+ (.*)$", text, flags=re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_what_is_wrong_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# One & two\n\n`rgbavatar render A B --shw x`\n\n```sh\nrgbavatar nothing  # --no\n```\n"
    )
    assert anchors(page) == {"one--two"}
    assert list(commands(page.read_text())) == [["nothing"], ["render", "A", "B", "--shw", "x"]]
    assert "--show" in help_of("render")
    assert "--shw" not in help_of("render")


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_somewhere(name: str) -> None:
    page = ROOT / name
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text())):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), f"{target} is not there"
        if anchor:
            assert anchor in anchors(linked), f"{target}: no such heading"


def commands(text: str) -> Iterator[list[str]]:
    """The words of each `rgbavatar ...` in code, up to what a shell adds."""
    blocks = re.findall(r"```(?:sh|bash)?\n(.*?)```", text, flags=re.S)
    inline = re.findall(r"`([^`\n]*(?:\n[^`\n]+)?)`", re.sub(r"```.*?```", "", text, flags=re.S))
    for line in [
        line for block in blocks for line in block.replace("\\\n", " ").split("\n")
    ] + inline:
        found = re.match(r"\s*(?:\.venv/bin/)?rgbavatar ([\w-]+.*)", line, flags=re.S)
        if found:
            words = re.split(r"\s#|[|>&;]", found[1])[0]
            yield shlex.split(words.replace("'", " "))


METHODS_OPTIONS = re.compile(r"^\| `(--[\w.-]+)", flags=re.M)
OF_NO_METHOD = {"collider-params"}
"""Named on a page because they are not there."""


def ns_train_options(text: str) -> Iterator[str]:
    """The options of each `ns-train METHOD ...` in code, and those named by their path."""
    code = "\n".join(re.findall(r"```.*?```|`[^`]*`", text, flags=re.S)).replace("\\\n", " ")
    for words in re.findall(r"ns-train [\w-]+-?[\w]*((?:[^\n`|>&;#]| \n)*)", code):
        yield from re.findall(r"(?<=\s)--[\w.-]+", words)
    yield from re.findall(r"--(?:pipeline|machine|viewer|logging)\.[\w.-]*\w", code)


def test_options_of_ns_train_are_found() -> None:
    text = "`ns-train rgbavatar --data D --viw x`\n`--pipeline.model.seed 3`\n"
    text += "```sh\nns-train a-b \\\n  --vis wandb  # --no\n```\n"
    assert list(ns_train_options(text)) == ["--data", "--viw", "--vis", "--pipeline.model.seed"]


@pytest.mark.parametrize("name", NAMES)
def test_options_of_ns_train_are_there(name: str) -> None:
    """By docs/commands.md, which another test compares with the parsers."""
    known = set(METHODS_OPTIONS.findall((ROOT / "docs" / "commands.md").read_text()))
    assert len(known) > 100
    for option in ns_train_options((ROOT / name).read_text()):
        if option != "--help" and option.split(".")[-1] not in OF_NO_METHOD:
            parts = {whole for whole in known if whole.startswith(f"{option}.")}
            assert option in known or parts, option


@cache
def help_of(command: str) -> str:
    told = io.StringIO()
    with contextlib.redirect_stdout(told), pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    return told.getvalue()


@pytest.mark.parametrize("name", NAMES)
def test_commands_and_their_options_are_there(name: str) -> None:
    for command, *words in commands((ROOT / name).read_text()):
        if command == "COMMAND":
            continue
        assert command in COMMANDS, f"rgbavatar {command}"
        helped = f"bench {words[0]}" if command == "bench" and words else command
        for word in words:
            option = word.split("=")[0]
            if option.startswith("--") and option != "--help":
                known = re.escape(option.replace("--no-", "--"))
                assert re.search(rf"{known}(?![\w-])", help_of(helped)), f"{helped} {option}"


@pytest.mark.parametrize("name", NAMES)
def test_python_snippets_compile_and_import_what_there_is(name: str) -> None:
    for block in re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(), flags=re.S):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rgbavatar_ns"):
                exec(compile(ast.Module([node], []), name, "exec"), {})
