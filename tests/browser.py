"""Chromium for the tests that look at a page."""

import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

_CHROMIUM = os.environ.get("RGBAVATAR_CHROMIUM") or shutil.which("chromium")
_FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update "
    "--disable-sync"
)
IN_BROWSER = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(_CHROMIUM is None, reason="no Chromium; set RGBAVATAR_CHROMIUM to its path"),
]


@contextmanager
def chromium() -> Iterator[Any]:
    """A headless browser of playwright's."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=_CHROMIUM, args=_FLAGS.split())
        yield browser
        browser.close()


def picture_of(png: bytes) -> npt.NDArray[np.uint8]:
    """RGB [H, W, 3]."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
