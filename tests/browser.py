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
_WEBGPU_FLAGS = (  # the page, too, is drawn by Vulkan, or a canvas of WebGPU would stay empty
    "--enable-unsafe-webgpu --use-webgpu-adapter=swiftshader --enable-features=Vulkan "
    "--use-vulkan=swiftshader"
)
IN_BROWSER = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(_CHROMIUM is None, reason="no Chromium; set RGBAVATAR_CHROMIUM to its path"),
]


@contextmanager
def chromium(webgpu: bool = False) -> Iterator[Any]:
    """A headless browser of playwright's, with WebGL2 alone or with WebGPU as well."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as driver:
        flags = [*_FLAGS.split(), *(_WEBGPU_FLAGS.split() if webgpu else ())]
        browser = driver.chromium.launch(executable_path=_CHROMIUM, args=flags)
        yield browser
        browser.close()


def picture_of(png: bytes) -> npt.NDArray[np.uint8]:
    """RGB [H, W, 3]."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
