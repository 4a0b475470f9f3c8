"""The avatar's file out of an exported page."""

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np

from rgbavatar_ns.export.avatar_file import read_avatar_file


def avatar_of_page(page: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """As `read_avatar_file` gives it: the manifest, and the arrays, items first."""
    parts = re.findall(r'class="part">([^<]*)</script>', page.read_text())
    file = page.with_suffix(".rgba")
    file.write_bytes(b"".join(map(base64.b64decode, parts)))
    try:
        return read_avatar_file(file)
    finally:
        file.unlink()
