"""The exported page in a real browser: the same picture as ours, and controls that answer."""

import base64
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.export import PageOptions, front_camera, pictures, write_web_page
from rgbavatar_ns.head import HeadArrays
from tests.avatar.small_head import small_head_arrays
from tests.browser import IN_BROWSER, chromium, picture_of

from .subject import avatar_of, lively_theta, psnr

_SIZE = 96

pytestmark = IN_BROWSER


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture
def open_page(browser: Any, tmp_path: Path) -> Iterator[Any]:
    """Opens an avatar's page from the disk; fails where the page asks for anything else."""
    context = browser.new_context(offline=True, viewport={"width": 900, "height": 500})
    asked: list[str] = []
    problems: list[str] = []

    def show(avatar: Avatar, theta: torch.Tensor) -> Any:
        file = tmp_path / "avatar.html"
        camera = front_camera(avatar, _SIZE, _SIZE)
        write_web_page(avatar, file, camera, theta, PageOptions(title="<me> & you"))
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(file.as_uri())
        page.evaluate(
            "size => rgbavatar.then((app) => { window.app = app; app.setSize(size, size); })", _SIZE
        )
        return page

    yield show
    context.close()
    assert not problems
    assert [url for url in asked if not url.startswith(("file:", "blob:"))] == []


def _shown(page: Any) -> np.ndarray:
    """The canvas [H, W, 3] in [0, 1], drawn now."""
    text = page.evaluate("() => { app.draw(); return app.canvas.toDataURL('image/png'); }")
    return picture_of(base64.b64decode(text.split(",")[1])).astype(np.float32) / 255


def _ours(avatar: Avatar, theta: torch.Tensor) -> np.ndarray:
    camera = front_camera(avatar, _SIZE, _SIZE)
    (picture,) = pictures(avatar, theta, camera, (1.0, 1.0, 1.0))
    return picture.astype(np.float32) / 255


def _head_like_flame() -> HeadArrays:
    """A small head with pose correctives, large enough to be seen, and with eyelids."""
    arrays = small_head_arrays()
    lids = arrays.shapedirs[..., :2] * np.array([1.0, -1.5], np.float32)
    return replace(arrays, posedirs=50 * arrays.posedirs, eyelid_dirs=lids)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {
            "arrays": _head_like_flame(),
            "tangent_variant": "orthonormal",
            "scale_with_triangle": True,
            "weight_network": "linear",
            "translation_input": True,
            "pose_input": False,
        },
        {"tangent_variant": "raw", "carrier": "joints", "weight_network": "none"},
        {"num_bases": 0},
    ],
    ids=["paper", "flame-like", "joints", "base"],
)
def test_the_page_shows_the_picture_that_render_draws(open_page, changes):
    avatar = avatar_of(**changes)
    theta = lively_theta(avatar, 2)
    page = open_page(avatar, theta)
    for frame in range(2):
        page.evaluate("frame => app.showFrame(frame)", frame)
        ours = _ours(avatar, theta[frame : frame + 1])
        assert ours.std() > 0.1, "there is something to see"
        quality = psnr(_shown(page), ours)
        assert quality > 45, quality


def test_sliders_change_the_picture_and_bring_it_back(open_page):
    avatar = avatar_of()
    page = open_page(avatar, torch.zeros(0, avatar.layout.size))
    before = _shown(page)
    jaw = page.locator("#slider-jaw-open")
    jaw.fill("0.3")
    changed = _shown(page)
    assert np.abs(changed - before).max() > 0.2
    theta = torch.zeros(1, avatar.layout.size)
    theta[0, avatar.layout.slice("jaw").start] = float(jaw.input_value())
    assert psnr(changed, _ours(avatar, theta)) > 45
    page.get_by_role("group").filter(has_text="Jaw and eyes").get_by_text("Reset").click()
    assert np.array_equal(_shown(page), before)

    smile = page.locator("#slider-mouthSmileLeft")
    smile.fill("0.75")
    assert np.abs(_shown(page) - before).max() > 0.03
    smile.fill("0")
    assert np.array_equal(_shown(page), before)


def test_a_basis_weight_can_be_held_against_the_network_and_released(open_page):
    avatar = avatar_of()
    page = open_page(avatar, torch.zeros(0, avatar.layout.size))
    before = _shown(page)
    page.get_by_text("Learned bases").click()
    slider = page.locator("#slider-psi-2")
    slider.fill(slider.get_attribute("max"))
    held = float(slider.input_value())
    changed = _shown(page)
    assert np.abs(changed - before).max() > 0.02
    theta = torch.zeros(1, avatar.layout.size)
    with torch.no_grad():
        psi = avatar.weights(theta)
    psi[0, 2] = held
    (ours,) = pictures(avatar, theta, front_camera(avatar, _SIZE, _SIZE), (1.0, 1.0, 1.0), psi)
    assert psnr(changed, ours / 255) > 45
    page.get_by_text("Back to the network").click()
    assert np.array_equal(_shown(page), before)


def test_playing_moves_the_performance_on_and_a_drag_turns_the_head(open_page):
    avatar = avatar_of()
    page = open_page(avatar, lively_theta(avatar, 20))
    assert page.title() == "<me> & you"
    page.locator("#play").click()
    page.wait_for_function("() => app.performance.place > 1")
    page.locator("#play").click()
    place = page.evaluate("() => app.performance.place")
    before = _shown(page)
    assert page.evaluate("() => app.performance.place") == place
    box = page.locator("#view").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 200, box["y"] + 200, steps=3)
    page.mouse.up()
    assert np.abs(_shown(page) - before).max() > 0.2
    page.get_by_text("Picture", exact=True).click()
    page.get_by_text("Camera back").click()
    assert np.array_equal(_shown(page), before)
