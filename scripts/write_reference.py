"""Write the pages that are read from the code, docs/commands.md and docs/errors.md.

    python -m scripts.write_reference

after options or errors have changed; a test compares the pages with what this writes.
"""

from itertools import groupby
from pathlib import Path

from rgbavatar_ns.files import atomic_write
from scripts.command_tables import command_pages, method_pages
from scripts.error_texts import GAP, ErrorText, error_texts

ROOT = Path(__file__).resolve().parents[1]
COMMANDS_PAGE, ERRORS_PAGE = ROOT / "docs" / "commands.md", ROOT / "docs" / "errors.md"
GROUPS = (
    ("Making and tracking films", ("tracking/", "synthetic/")),
    ("Checking data", ("data/check/",)),
    ("Other systems' data", ("data/importers/",)),
    ("Streams", ("data/streams/", "plugin/online/")),
    ("Datasets and images", ("data/native/", "data/png.py", "data/opening.py", "data/")),
    ("FLAME and head models", ("head/",)),
    ("Avatars and checkpoints", ("avatar/",)),
    ("Training and the viewer", ("plugin/",)),
    ("The GPU", ("kernels/",)),
    ("Driving", ("driving/",)),
    ("Films, pages and files", ("export/",)),
    ("Experiments and benchmarks", ("experiments/", "bench/")),
    ("Commands, options and the disk", ("cli/", "")),
)
"""In this order; a module belongs to the first group that has a beginning of its path."""


def commands_page() -> str:
    """docs/commands.md."""
    return _page(
        "# Every command and option",
        "Written by `make reference` from the parsers themselves; `rgbavatar COMMAND --help` and "
        "`ns-train METHOD --help` show the same. What to do with them: [tasks.md](tasks.md).",
        "An option that is on or off is given as `--name` or `--no-name` to `rgbavatar`, and as "
        "`--name True` or `--name False` to nerfstudio's commands.",
        "## rgbavatar",
        *command_pages(),
        "## ns-train",
        "Beside these there are nerfstudio's own commands, `ns-eval`, `ns-viewer`, `ns-render` and "
        "`ns-export`: [nerfstudio.md](nerfstudio.md).",
        *method_pages(),
    )


def errors_page() -> str:
    """docs/errors.md."""
    texts = error_texts(ROOT / "rgbavatar_ns")
    told = [text for text in texts if text.kind == "told"]
    reasons = sorted({text.cause for text in texts if text.kind == "reason"})
    sections = []
    ordered = sorted(told, key=lambda text: _group(text))
    for number, group in groupby(ordered, key=_group):
        rows = dict.fromkeys((cell(text.cause), _remedy(text)) for text in group)
        lines = [f"| {cause} | {remedy} |" for cause, remedy in sorted(rows, key=_first_words)]
        head = "| it says | what to do |\n| --- | --- |\n"
        sections += [f"## {GROUPS[number][0]}", head + "\n".join(lines)]
    return _page(
        "# Every error, by its words",
        "Written by `make reference` from the sources. What may be put in, a path, a name or a "
        f"number, is written {GAP} here; so search this page for the words between. Each error "
        "says itself what to do; why it happens, where that needs more words, is in "
        "[troubleshooting.md](troubleshooting.md).",
        *sections,
        "## Warnings",
        "\n".join(f"- {cell(text.cause)}" for text in texts if text.kind == "warning"),
        "## Reasons that errors give",
        'Where an error ends in a reason, as "cannot be read: it is cut off", the reason is one '
        "of these, or the system's own. The file was damaged, cut short, or made to do harm: get "
        "or write it anew.",
        "\n".join(f"- {cell(reason)}" for reason in reasons),
    )


def _first_words(row: tuple[str, str]) -> str:
    return row[0].lstrip(f"{GAP}: ")


def _group(text: ErrorText) -> int:
    return next(
        number
        for number, (_, places) in enumerate(GROUPS)
        if any(text.module.startswith(place) for place in places)
    )


def _remedy(text: ErrorText) -> str:
    return "(told with it)" if text.remedy.strip(f"{GAP} .") == "" else cell(text.remedy)


def cell(text: str) -> str:
    """Text as Markdown shows it unchanged: signs are marked where they are in no code."""
    parts = text.split("`")
    if len(parts) % 2 == 0:
        parts = [text.replace("`", "\\`")]
    for sign in "\\*_<[":
        parts[::2] = [part.replace(sign, "\\" + sign) for part in parts[::2]]
    marked = "`".join(parts).replace("\\\\`", "\\`")
    return " ".join(marked.replace("|", "\\|").split())


def _page(*blocks: str) -> str:
    return "\n\n".join(block for block in blocks if block) + "\n"


def main() -> None:
    """Write both pages."""
    for path, page in ((COMMANDS_PAGE, commands_page()), (ERRORS_PAGE, errors_page())):
        with atomic_write(path) as partial:
            partial.write_text(page)
        print(f"{path.relative_to(ROOT)}: {page.count(chr(10))} lines")


if __name__ == "__main__":
    main()
