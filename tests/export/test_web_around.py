"""The page driven by the page around it, by keys and by fingers, in a browser."""

from typing import Any

import numpy as np
import pytest

from tests.browser import IN_BROWSER

from .driven_page import ready, shows, theta_message

pytestmark = IN_BROWSER


def _around(context: Any, origin: str, name: str) -> Any:
    page = context.new_page()
    page.goto(f"{origin}/{name}")
    return page


def _inner(page: Any) -> Any:
    """The avatar's page within."""
    frame = page.frames[1]
    frame.wait_for_function("() => window.rgbavatar")
    return ready(frame)


def test_a_page_of_a_named_origin_drives_and_is_answered(context, site, avatar, theta):
    page = _around(context, site[1][0], "around.html")
    inner = _inner(page)
    page.wait_for_function("() => answers.length === 1")
    ready = page.evaluate("() => answers[0]")
    assert (ready["type"], ready["layout"]) == ("ready", avatar.layout.to_json())
    page.evaluate("message => say(message)", theta_message(7, theta[7]))
    shows(inner, theta[7])
    page.wait_for_function("() => answers.length === 2")
    assert page.evaluate("() => answers[1]") == {"type": "shown", "index": 7}
    page.evaluate("() => say({ type: 'arkit', coefficients: { jawOpen: NaN, mouthSmileLeft: 1 } })")
    shows(inner, avatar.theta_from_arkit({"mouthSmileLeft": 1.0}))
    page.evaluate("() => say({ type: 'orbit', yaw: 0.2, pitch: -0.1 })")
    inner.wait_for_function("() => avatar.camera.angles()[0] > 0.1")
    assert inner.evaluate("() => avatar.camera.angles()") == pytest.approx([0.2, -0.1])
    page.evaluate("() => say({ type: 'play' })")
    inner.wait_for_function("() => avatar.performance.playing")
    page.evaluate("() => say({ type: 'pause' })")
    inner.wait_for_function("() => !avatar.performance.playing")


def test_what_a_named_origin_says_wrongly_is_answered_with_the_reason(context, site, avatar):
    page = _around(context, site[1][0], "around.html")
    inner = _inner(page)
    page.wait_for_function("() => answers.length === 1")
    before = inner.evaluate("() => avatar.theta")
    for script, said in (
        ("{ type: 'theta', theta: new Array(3) }", "theta has 3 numbers"),
        (
            f"{{ type: 'theta', theta: new Array({avatar.layout.size}).fill(NaN) }}",
            "theta[0] is NaN",
        ),
        ("{ type: 'orbit', yaw: 'left', pitch: 0 }", 'is the text "left"'),
        ("{ type: 'arkit', pose: { rotation: [NaN, 0, 0] } }", "pose.rotation[0] is NaN"),
        ("'nonsense'", "a message is no object"),
        ("{ type: 'hello', format: 'rgbavatar-drive', version: 3 }", "another version"),
    ):
        page.evaluate("() => { answers.length = 0; }")
        page.evaluate(f"() => say({script})")
        page.wait_for_function("() => answers.length === 1")
        answer = page.evaluate("() => answers[0]")
        assert answer["type"] == "error"
        assert said in answer["text"]
    assert inner.evaluate("() => avatar.theta") == before


def test_no_other_origin_is_listened_to_or_spoken_to(context, site, theta):
    page = _around(context, site[1][1], "stranger.html")
    inner = _inner(page)
    before = inner.evaluate("() => avatar.theta")
    # The frame hears itself afterwards, so that the stranger's message has come by then.
    inner.evaluate("() => { window.heard = 0; window.addEventListener('message', () => heard++); }")
    page.evaluate("message => say(message)", theta_message(0, theta[0]))
    inner.wait_for_function("() => heard > 0")
    assert inner.evaluate("() => avatar.theta") == before
    assert page.evaluate("() => answers") == []


def test_the_pages_own_origin_is_not_enough(context, site, theta):
    page = context.new_page()
    page.goto(f"{site[1][1]}/avatar.html")
    ready(page)
    before = page.evaluate("() => avatar.theta")
    page.evaluate(
        """async (message) => {
          const heard = new Promise((done) => window.addEventListener("message", done));
          window.postMessage(message, "*");
          await heard;
        }""",
        theta_message(0, theta[0]),
    )
    assert page.evaluate("() => avatar.theta") == before


def test_keys_turn_zoom_reset_play_and_fold(open_page):
    page = open_page()
    at_rest = page.evaluate("() => avatar.theta")
    page.locator("body").press("ArrowRight")
    page.locator("body").press("ArrowUp")
    assert np.degrees(page.evaluate("() => avatar.camera.angles()")) == pytest.approx([5, -5])
    page.locator("body").press("+")
    assert page.evaluate("() => avatar.camera.nearness") == pytest.approx(1.1)
    page.locator("body").press("f")
    assert page.locator("#panel").is_hidden()
    page.locator("body").press("f")
    assert page.locator("#panel").is_visible()
    page.locator("body").press(" ")
    page.wait_for_function("() => avatar.performance.place > 0")
    page.locator("body").press("r")
    assert page.evaluate("() => [avatar.theta, avatar.camera.angles()]") == [at_rest, [0, 0]]
    assert not page.evaluate("() => avatar.performance.playing")
    # On a slider arrows are the slider's.
    page.locator("#slider-jaw-open").press("ArrowRight")
    assert page.evaluate("() => avatar.camera.angles()") == [0, 0]
    assert page.evaluate("() => avatar.theta") != at_rest
    # Other keys mean nothing to it.
    page.locator("#slider-jaw-open").press("f")
    assert page.locator("#panel").is_hidden()
    page.locator("body").press("f")
    page.locator("#slider-jaw-open").press(" ")
    assert page.evaluate("() => avatar.performance.playing")


def test_on_a_phone_the_face_comes_first_and_fingers_turn_and_zoom(browser, site, tmp_path):
    context = browser.new_context(
        viewport={"width": 390, "height": 844}, device_scale_factor=3, has_touch=True
    )
    page = context.new_page()
    page.goto((site[0] / "avatar.html").as_uri())
    page.evaluate("() => rgbavatar.then((app) => { window.avatar = app.avatar; })")
    box = page.locator("#view").bounding_box()
    assert (box["width"], box["height"]) == (390, 844)
    assert page.locator("#panel").is_hidden()
    assert page.evaluate("() => avatar.canvas.width") == 780, "no more than two pixels a point"
    # The 64 x 64 home picture is cut at its sides for a larger face, about the head's middle.
    camera = page.evaluate("() => avatar.camera.at(390, 844, avatar.headCentre)")
    home = page.evaluate("() => avatar.camera.home")
    assert camera["focal"][0] == pytest.approx(1.4 * home["focal"][0] * 390 / 64)
    x, _, z = np.reshape(camera["rotation"], (3, 3)) @ page.evaluate("() => avatar.headCentre")
    right, forward = camera["translation"][0], z + camera["translation"][2]
    column = camera["focal"][0] * (x + right) / forward + camera["principal"][0]
    assert column == pytest.approx(390 / 2, abs=1e-3)
    ready(page)
    touch = context.new_cdp_session(page)

    def fingers(kind: str, *places: tuple[int, int]) -> None:
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", (200, 400))
    fingers("touchMove", (160, 400))
    fingers("touchEnd")
    assert page.evaluate("() => avatar.camera.pulled[0]") == pytest.approx(3 * 40 / 844, rel=0.01)
    fingers("touchStart", (150, 400), (250, 400))
    fingers("touchMove", (100, 420), (300, 420))
    fingers("touchEnd")
    nearness, shift = page.evaluate("() => [avatar.camera.nearness, avatar.camera.shift]")
    assert nearness == pytest.approx(2, rel=0.01)
    assert shift == pytest.approx([0, 0.35 * 20 / 844], abs=1e-4)
    page.locator("#fold").tap()
    assert page.locator("#panel").is_visible()
    assert page.locator("#view").bounding_box()["height"] > 844 / 2
    context.close()
