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
from rgbavatar_ns.avatar.orbit import head_centre, orbit
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.export import PageOptions, front_camera, pictures, write_web_page
from rgbavatar_ns.head import HeadArrays, turn_seen
from tests.avatar.small_head import small_head_arrays
from tests.browser import IN_BROWSER, picture_of

from .subject import avatar_of, lively_theta, psnr

_SIZE = 96

pytestmark = IN_BROWSER


@pytest.fixture
def open_page(browser: Any, tmp_path: Path) -> Iterator[Any]:
    """Opens an avatar's page from the disk; fails where the page asks for anything else."""
    context = browser.new_context(offline=True, viewport={"width": 900, "height": 500})
    asked: list[str] = []
    problems: list[str] = []

    def show(avatar: Avatar, theta: torch.Tensor, seen: TrainingStatistics | None = None) -> Any:
        file = tmp_path / "avatar.html"
        camera = front_camera(avatar, _SIZE, _SIZE)
        write_web_page(avatar, file, camera, theta, PageOptions(title="<me> & you"), seen)
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.goto(file.as_uri())
        page.evaluate(
            """size => rgbavatar.then(async (app) => {
              window.avatar = app.avatar; avatar.setSize(size, size); await avatar.complete;
            })""",
            _SIZE,
        )
        return page

    yield show
    context.close()
    assert not problems
    assert [url for url in asked if not url.startswith(("file:", "blob:"))] == []


def test_what_runs_no_programs_says_so_and_unpacks_nothing(browser, tmp_path):
    context = browser.new_context(offline=True, java_script_enabled=False)
    avatar = avatar_of()
    nothing = torch.zeros(0, avatar.layout.size)
    write_web_page(avatar, tmp_path / "a.html", front_camera(avatar, 8, 8), nothing)
    page = context.new_page()
    page.goto((tmp_path / "a.html").as_uri())
    told = page.inner_text("#told")
    context.close()
    assert told.strip() == (
        "This preview runs no programs: open the page in a browser, from a web address."
    )


def _shown(page: Any) -> np.ndarray:
    """The canvas [H, W, 3] in [0, 1], drawn now."""
    text = page.evaluate("() => { avatar.draw(); return avatar.canvas.toDataURL('image/png'); }")
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
        page.evaluate("frame => avatar.performance.seek(frame)", frame)
        ours = _ours(avatar, theta[frame : frame + 1])
        assert ours.std() > 0.1, "there is something to see"
        quality = psnr(_shown(page), ours)
        assert quality > 45, quality


def test_beyond_the_film_the_pages_weights_are_those_of_the_avatar(open_page):
    avatar = avatar_of()
    theta = lively_theta(avatar, 2)
    with torch.no_grad():  # a trained network's weights are of size one, a new one's of a tenth
        for parameter in avatar.weight_network.layers[-1].parameters():
            parameter.mul_(15)
    unbound = _ours(avatar, theta[:1])
    avatar.widen_film_range(0.2 * theta)
    page = open_page(avatar, theta)
    for frame in range(2):
        page.evaluate("frame => avatar.performance.seek(frame)", frame)
        assert psnr(_shown(page), _ours(avatar, theta[frame : frame + 1])) > 45
    assert psnr(unbound, _ours(avatar, theta[:1])) < 36, "the range changes something"


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
    page.wait_for_function("() => avatar.performance.place > 1")
    page.locator("#play").click()
    place = page.evaluate("() => avatar.performance.place")
    before = _shown(page)
    assert page.evaluate("() => avatar.performance.place") == place
    box = page.locator("#view").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 200, box["y"] + 200, steps=3)
    page.mouse.up()
    assert np.abs(_shown(page) - before).max() > 0.2
    page.get_by_text("Picture", exact=True).click()
    page.get_by_text("Camera back").click()
    assert np.array_equal(_shown(page), before)


def _drag(page: Any, across: int, down: int = 0) -> None:
    """Press at the middle of the view and move, without letting go."""
    box = page.locator("#view").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + across, y + down, steps=4)


def _degrees_seen(page: Any) -> np.ndarray:
    """Yaw and pitch, from the camera that draws."""
    page.evaluate("() => avatar.draw()")
    return np.degrees(page.evaluate("() => avatar.turnSeen"))


def test_the_camera_gives_way_beyond_the_film_comes_back_and_says_so(open_page):
    avatar = avatar_of()
    theta = 0.2 * lively_theta(avatar, 60)
    theta[:, avatar.layout.slice("translation")] += torch.tensor([0.05, -0.03, 0.1])
    camera = front_camera(avatar, _SIZE, _SIZE)
    with torch.no_grad():
        seen = TrainingStatistics.of(
            theta, avatar.weights(theta), avatar.layout, camera.world_to_camera
        )
    page = open_page(avatar, theta, seen)
    page.evaluate("() => avatar.performance.seek(0)")
    ours = turn_seen(theta[:1], camera.world_to_camera, avatar.layout)[0, :2].numpy()
    assert np.allclose(_degrees_seen(page), ours, atol=0.01)
    said = page.locator("#beyond")
    assert said.text_content() == ""
    low, high = (end.numpy() for end in seen.turn_reach())

    _drag(page, -300)
    pulled = _degrees_seen(page)
    assert high[0] + 3 < pulled[0] < high[0] + 15, "it resists"
    assert "Beyond the film: seen from" in said.text_content()
    page.mouse.up()
    page.wait_for_function("() => !avatar.camera.settle(0)")
    assert _degrees_seen(page)[0] == pytest.approx(high[0], abs=0.1)
    page.evaluate("() => avatar.camera.reset()")
    assert np.allclose(_degrees_seen(page), ours, atol=0.01)
    assert said.text_content() == ""

    # The same picture as ours from there, about the same centre.
    _drag(page, -40, 20)
    page.mouse.up()
    yaw, pitch = torch.tensor(page.evaluate("() => avatar.camera.angles()")).rad2deg()
    there = orbit(camera, head_centre(avatar, theta[:1]), yaw[None], pitch[None])
    (expected,) = pictures(avatar, theta[:1], there, (1.0, 1.0, 1.0))
    assert psnr(_shown(page), expected / 255) > 40

    page.get_by_text("Picture", exact=True).click()
    page.locator("#turn-freely").check()
    _drag(page, 400)
    page.mouse.up()
    assert _degrees_seen(page)[0] < low[0] - 40
    assert "right" in said.text_content()


def test_a_head_beside_the_principal_point_stays_in_its_place_when_it_comes_nearer(open_page):
    avatar = avatar_of()
    page = open_page(avatar, torch.zeros(1, avatar.layout.size))
    places = page.evaluate(
        """() => {
          const home = { ...avatar.camera.home, principal: [10, 80] }, centre = [0.05, -0.1, 0.02];
          home.translation = home.translation.map((value, i) => value + [0.08, -0.06, 0][i]);
          const camera = new OrbitCamera(home, avatar.camera.reach);
          return [1, 0.5, 3].map((nearness) => {
            camera.nearness = nearness;
            const { rotation, translation, focal, principal } = camera.at(96, 96, centre);
            const [x, y, z] = apply3(rotation, centre).map((value, i) => value + translation[i]);
            return [focal[0] * x / z + principal[0], focal[1] * y / z + principal[1], z];
          });
        }"""
    )
    home, far, near = np.array(places)
    assert np.abs(home[:2] - [10, 80]).min() > 5, "it is beside the principal point"
    for nearness, place in ((0.5, far), (3, near)):
        np.testing.assert_allclose(place[:2], home[:2], atol=1e-3)
        assert place[2] == pytest.approx(home[2] / nearness)


def test_sliders_show_the_film_and_jaws_only_open(open_page):
    avatar = avatar_of()
    theta = lively_theta(avatar, 30)
    with torch.no_grad():
        seen = TrainingStatistics.of(theta, avatar.weights(theta), avatar.layout)
    page = open_page(avatar, theta, seen)
    jaw = page.locator("#slider-jaw-open")
    assert jaw.get_attribute("min") == "0"
    low, high = seen.film_range()
    place = avatar.layout.slice("jaw").start
    ends = page.evaluate(
        "() => [...document.querySelector('#slider-jaw-open').list.options]"
        ".map((end) => Number(end.value))"
    )
    filmed = [max(0.0, float(low[place])), float(high[place])]
    assert ends == pytest.approx(filmed, abs=0.002)
    jaw.fill("0.5")
    _shown(page)
    assert "jaw open" in page.locator("#beyond").text_content()
    assert page.locator(".row.beyond #slider-jaw-open").count() == 1
    jaw.fill("0.05")
    _shown(page)
    assert "jaw open" not in page.locator("#beyond").text_content()
