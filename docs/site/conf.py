"""The site of the documentation: `make docs` builds it into build/site.

The pages are plain Markdown that reads as well where it lies: what only the site has is here. Its
source is the whole repository, so that links to README.md and configs/ lead somewhere too.
"""

from sphinx.application import Sphinx

project = "rgbavatar_ns"
author = "The authors of rgbavatar_ns"
root_doc = "docs/index"

NAVIGATION = {
    "Start": ("install", "filming", "track", "check", "train", "troubleshooting"),
    "Use an avatar": ("look", "render", "driving", "web", "edit_and_export"),
    "More data": ("dataset_format", "flame", "online"),
    "Reference": ("tasks", "commands", "errors", "nerfstudio", "python", "python_reference"),
    "Figures": ("quality", "speed", "gpu", "beyond", "rivals", "results", "others"),
    "Inside": ("inside", "architecture", "paper", "tracking", "extend", "../configs/README"),
    "The project": ("../README", "upgrade", "../CHANGELOG", "../CONTRIBUTING"),
}
"""Every page once, by title of its group; paths from docs/."""

include_patterns = [
    "docs/*.md",
    "configs/README.md",
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
suppress_warnings: list[str] = []
# Docstrings name code in single quotes of Markdown's kind.
default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 80
maximum_signature_line_length = 80
# "--flame" is to stay so, and quotes as a program prints them.
smartquotes = False
html_theme = "furo"
html_title = project
html_copy_source = False
html_show_sourcelink = False
html_extra_path = ["index.html"]


def add_navigation(app: Sphinx, docname: str, source: list[str]) -> None:
    """Give the first page the list of all others, which Markdown readers need not see."""
    if docname != root_doc:
        return
    for title, pages in NAVIGATION.items():
        lines = "\n".join(pages)
        source[0] += f"\n```{{toctree}}\n:caption: {title}\n:hidden:\n\n{lines}\n```\n"


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", add_navigation)
