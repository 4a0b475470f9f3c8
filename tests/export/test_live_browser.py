"""The page of `rgbavatar drive` in a real browser: driven, lost, found again."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.driving.live_drive import DrivenFrame
from rgbavatar_ns.export import PageOptions, front_camera, write_web_page
from rgbavatar_ns.export.live_page import PageOutput
from tests.browser import IN_BROWSER, chromium

from .subject import avatar_of, lively_theta

pytestmark = IN_BROWSER


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


def _page(path: Path, own_server: bool = False) -> bytes:
    avatar = avatar_of()
    nothing = torch.zeros(0, avatar.layout.size)
    options = PageOptions(own_server=own_server)
    write_web_page(avatar, path, front_camera(avatar, 64, 64), nothing, options)
    return path.read_bytes()


def _show_until_answered(output: PageOutput, theta: torch.Tensor, first: int) -> int:
    """Send frames until the page has told that it has shown one; the last one's place."""
    before = output.latencies.shown
    for index in range(first, first + 500):
        row = theta[index % len(theta)]
        output.show(DrivenFrame(index, row, time.monotonic(), index / 25))
        time.sleep(0.04)
        if output.latencies.shown > before + 2:
            return index
    raise AssertionError("the page answers nothing")


def test_a_served_page_follows_and_comes_back_after_a_loss(browser, tmp_path):
    content, avatar = _page(tmp_path / "page.html"), avatar_of()
    theta = lively_theta(avatar, 20)
    output = PageOutput(avatar.layout, "127.0.0.1:0", page=lambda: content)
    address = output.address
    context = browser.new_context(viewport={"width": 390, "height": 844})
    problems: list[str] = []
    context.on("weberror", lambda error: problems.append(str(error.error)))
    try:
        page = context.new_page()
        page.goto(f"http://{address}/?ws=ws://{address}")
        page.evaluate(
            "() => rgbavatar.then((app) => { window.avatar = app.avatar; avatar.setSize(48, 48); })"
        )
        last = _show_until_answered(output, theta, 0)
        # The newest frame is what the page stands on.
        for _ in range(50):
            shown = np.array(page.evaluate("() => Array.from(avatar.theta)"))
            if np.allclose(shown, theta[last % len(theta)].numpy(), atol=1e-5):
                break
            time.sleep(0.05)
        assert np.allclose(shown, theta[last % len(theta)].numpy(), atol=1e-5)
        assert 0 < output.latencies.quantile_s(0.5) < 2.0
        output.close()
        page.wait_for_function("() => /performance has ended/i.test(document.body.innerText)")
        output = PageOutput(avatar.layout, address, page=lambda: content)
        last = _show_until_answered(output, theta, 1000)
        assert last > 1000
    finally:
        context.close()
        output.close()
    assert not problems


def test_a_page_from_the_disk_is_driven_by_the_whole_address_alone(browser, tmp_path):
    avatar = avatar_of()
    _page(tmp_path / "page.html")
    output = PageOutput(avatar.layout, "127.0.0.1:0")
    context = browser.new_context(viewport={"width": 390, "height": 844})
    url = (tmp_path / "page.html").as_uri()
    try:
        page = context.new_page()
        page.goto(f"{url}?ws=ws://{output.address}")
        page.wait_for_function("() => /whole address with its key/.test(document.body.innerText)")
        page.goto(f"{url}?ws=ws://{output.keyed_address}")
        page.evaluate("() => rgbavatar.then((app) => app.avatar.setSize(48, 48))")
        _show_until_answered(output, lively_theta(avatar, 20), 0)
    finally:
        context.close()
        output.close()


def test_a_page_that_another_machine_gets_is_driven_by_its_server(browser, tmp_path):
    """By a number that is not 127.0.0.1, as on a phone; a page for the disk is kept from it."""
    avatar = avatar_of()
    contents = [_page(tmp_path / "served.html", own_server=True), _page(tmp_path / "disk.html")]
    context = browser.new_context(viewport={"width": 390, "height": 844})
    output = PageOutput(avatar.layout, "0.0.0.0:0", allow_remote=True, page=lambda: contents[0])
    try:
        page = context.new_page()
        # Linux answers at all of 127/8, which for the browser is not the name of this machine.
        address = output.keyed_address.split("/")[0].replace("127.0.0.1", "127.0.0.2")
        page.goto(f"http://{address}/?ws=ws://{address}")
        page.evaluate("() => rgbavatar.then((app) => app.avatar.setSize(48, 48))")
        _show_until_answered(output, lively_theta(avatar, 20), 0)
        contents[0] = contents[1]
        page.goto(f"http://{address}/?ws=ws://{address}")
        page.wait_for_function("() => /is not driven from/.test(document.body.innerText)")
    finally:
        context.close()
        output.close()
