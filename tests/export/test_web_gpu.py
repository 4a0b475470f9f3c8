"""The module and the page drawn with WebGPU: Python's pictures and WebGL2's; where there is none."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.export import PageOptions, front_camera, write_web_page
from tests.browser import IN_BROWSER, chromium

from .module_page import PAGE, SIZE, canvas_of, drawn_by_us, load_avatar
from .subject import avatar_of, psnr

pytestmark = IN_BROWSER

_WATCH = """
window.problems = [];
window.devices = [];
if (window.GPUAdapter) { // not on the blank page before
  const request = GPUAdapter.prototype.requestDevice;
  GPUAdapter.prototype.requestDevice = async function (...given) {
    const device = await request.apply(this, given);
    device.addEventListener("uncapturederror", ({ error }) => problems.push(error.message));
    devices.push(device);
    return device;
  };
}
"""
"""Gathers what the GPU finds wrong, which it tells late."""


@pytest.fixture(scope="module")
def browser(origin) -> Iterator[Any]:
    with chromium(webgpu=True) as browser:
        page = browser.new_page()
        page.goto(f"{origin}/page.html")
        if not page.evaluate(
            "async () => Boolean(navigator.gpu && await navigator.gpu.requestAdapter())"
        ):
            pytest.skip("this browser gives no WebGPU adapter")
        page.close()
        yield browser


@pytest.fixture
def bare_page(browser, origin) -> Iterator[Any]:
    """As the module's, where the GPU's complaints, too, fail the test."""
    context = browser.new_context(viewport={"width": 400, "height": 300})
    context.add_init_script(_WATCH)
    problems: list[str] = []
    context.on("weberror", lambda error: problems.append(str(error.error)))
    page = context.new_page()
    page.goto(f"{origin}/page.html")
    yield page
    problems += page.evaluate(
        """async () => {
          for (const device of devices) await device.queue.onSubmittedWorkDone().catch(() => {});
          return problems;
        }"""
    )
    context.close()
    assert not problems


def _set(page: Any, theta: torch.Tensor) -> None:
    page.evaluate("numbers => avatar.setTheta(numbers)", theta.double().tolist())


def test_webgpu_draws_where_there_is_one_what_render_draws(page, avatar, theta, neutral):
    assert page.evaluate("() => avatar.rendererKind") == "webgpu"
    shown = canvas_of(page)
    assert psnr(shown[..., :3], drawn_by_us(avatar, neutral)[0]) > 45
    assert (shown[..., 3] == 1).all()
    for numbers in theta[:3]:
        _set(page, numbers)
        assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, numbers)[0]) > 45
