"""The page driven from outside, in a browser: a WebSocket, the page around it, keys, fingers."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.export import PageOptions, front_camera, write_web_page
from tests.browser import IN_BROWSER, chromium

from .drive_server import DriveServer, hello
from .local_site import served
from .subject import avatar_of, lively_theta

pytestmark = IN_BROWSER
_FRAMES = 40


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return avatar_of()


@pytest.fixture(scope="module")
def theta(avatar) -> torch.Tensor:
    return lively_theta(avatar, _FRAMES)


@pytest.fixture(scope="module")
def site(avatar, theta, tmp_path_factory) -> Iterator[Any]:
    """A folder with the page on two servers, so two origins; the page listens to the first."""
    folder = tmp_path_factory.mktemp("site")
    with served(folder) as named, served(folder) as stranger:
        _fill(folder, avatar, theta, named)
        yield folder, (named, stranger)


def _fill(folder: Path, avatar: Avatar, theta: torch.Tensor, origin: str) -> None:
    options = PageOptions(origins=(origin,), servers=("ws://drive.example:8765",))
    camera = front_camera(avatar, 64, 64)
    write_web_page(avatar, folder / "avatar.html", camera, theta, options)
    for name in ("around.html", "stranger.html"):
        (folder / name).write_text(_AROUND.replace("{{page}}", f"{origin}/avatar.html"))


_AROUND = """<!doctype html><title>around</title>
<script>
  window.answers = [];
  window.addEventListener("message", (event) => answers.push(event.data));
  const say = (message) => document.querySelector("iframe").contentWindow.postMessage(message, "*");
</script>
<iframe src="{{page}}" width="500" height="400"></iframe>"""


@pytest.fixture
def context(browser) -> Iterator[Any]:
    """A window as wide as a desk's and, for speed, low; errors in a page fail the test."""
    context = browser.new_context(viewport={"width": 800, "height": 200})
    problems: list[str] = []
    context.on("weberror", lambda error: problems.append(str(error.error)))
    yield context
    context.close()
    assert not problems


def _ready(page: Any) -> Any:
    """The page once its avatar is there, drawn small, which is fast."""
    page.evaluate(
        "() => rgbavatar.then((app) => { Object.assign(window, { app, avatar: app.avatar });"
        " avatar.setSize(64, 64); })"
    )
    return page


@pytest.fixture
def open_page(context, site) -> Any:
    """Opens the page from the disk, with a query."""

    def show(query: str = "") -> Any:
        page = context.new_page()
        page.goto((site[0] / "avatar.html").as_uri() + query)
        return _ready(page)

    return show


@pytest.fixture
def server() -> Iterator[DriveServer]:
    server = DriveServer()
    yield server
    server.close()


def _theta_message(index: int, theta: torch.Tensor) -> dict[str, Any]:
    return {"type": "theta", "index": index, "theta": theta.double().tolist()}


def _says(page: Any, text: str) -> None:
    """Wait until the page says so of its connection."""
    page.wait_for_function(
        "text => document.querySelector('#live').textContent.includes(text)",
        arg=text,
    )


def _shows(page: Any, theta: torch.Tensor) -> None:
    """Wait until the avatar has this theta."""
    page.wait_for_function(
        "wanted => avatar.theta.every((value, i) => Math.abs(value - wanted[i]) < 1e-6)",
        arg=theta.double().tolist(),
    )


@pytest.fixture
def driven(open_page, server, avatar) -> Any:
    """A page that a server drives."""
    page = open_page(f"?ws=ws://127.0.0.1:{server.port}")
    server.wait_for_page()
    server.send(hello(avatar))
    _says(page, f"connected to 127.0.0.1:{server.port}")
    return page


def test_every_drawn_message_is_answered_and_the_newest_wins(driven, server, theta):
    server.send(_theta_message(3, theta[3]))
    assert server.received.get(timeout=20) == {"type": "shown", "index": 3}
    _shows(driven, theta[3])
    server.send(*[_theta_message(10 + i, theta[i]) for i in range(20)])
    _shows(driven, theta[19])
    answered = []
    while not answered or answered[-1] < 29:
        answered.append(server.received.get(timeout=20)["index"])
    assert answered == sorted(set(answered))
    assert len(answered) < 20, "pictures of older messages are skipped"


def test_arkit_and_status_messages_are_followed(driven, server, avatar):
    turn = [0.0, 0.2, 0.1]
    server.send(
        {
            "type": "arkit",
            "index": 1,
            "coefficients": {"jawOpen": 0.5, "mouthSmileLeft": 7, "madeUp": 1},
            "pose": {"rotation": turn, "translation": [0.01, 0, 0]},
        }
    )
    wanted = avatar.theta_from_arkit({"jawOpen": 0.5, "mouthSmileLeft": 1}, torch.tensor(turn))
    wanted[avatar.layout.slice("translation").start] += 0.01
    _shows(driven, wanted)
    server.send({"type": "status", "text": "<b>calibrating</b>"})
    _says(driven, ": <b>calibrating</b>")
    assert driven.locator("#live b").count() == 0


def test_whoever_performs_can_be_calibrated_from_the_page(driven, server):
    driven.locator("#calibrate").click()
    assert server.received.get(timeout=20) == {"type": "calibrate"}
    driven.locator("#view").press("c")
    assert server.received.get(timeout=20) == {"type": "calibrate"}


def test_a_lost_connection_is_told_and_comes_back(open_page, avatar, theta):
    first = DriveServer()
    page = open_page(f"?ws=ws://127.0.0.1:{first.port}")
    first.wait_for_page()
    first.send(hello(avatar), _theta_message(0, theta[0]))
    _shows(page, theta[0])
    first.close()
    _says(page, "connection lost, trying again in 1 s")
    _says(page, "no answer from")
    _says(page, "trying again in 2 s")
    assert page.locator("#live.problem").count() == 1
    assert page.locator("#calibrate").is_hidden()
    _shows(page, theta[0])
    second = DriveServer(first.port)
    second.wait_for_page()
    second.send(hello(avatar), _theta_message(0, theta[1]))
    _shows(page, theta[1])
    _says(page, "connected to")
    assert page.locator("#live.problem").count() == 0
    second.close()


_UNUSABLE = (
    ("no JSON {", 'a message is no JSON: "no JSON {"'),
    ("[1, 2]", "a message is no object"),
    ("null", "a message is no object"),
    ('{"type": "theta", "index": 1, "theta": [NaN]}', "a message is no JSON"),
    ({"type": "theta", "index": 1, "theta": [0.0]}, "theta has 1 numbers; expected"),
    ({"type": "theta", "index": 1}, "theta is undefined"),
    ({"type": "theta", "theta": "x" * 500}, 'theta is the text "xxx'),
    ({"type": "arkit", "coefficients": {"jawOpen": "wide"}}, 'jawOpen is the text "wide"'),
    ({"type": "arkit", "coefficients": [1]}, "The coefficients are of type object"),
    ({"type": "arkit", "pose": {"rotation": [1]}}, "pose.rotation has 1 numbers"),
    ({"type": "dance"}, 'there is no message of type the text "dance"'),
    ({"type": "orbit", "yaw": 1, "pitch": 0}, "there is no message of type"),
    ({"type": "status", "text": 3}, "a status is no text"),
    ("x" * 200_000, "a message is no text, or too long"),
)


def test_what_cannot_be_used_is_told_and_the_next_message_is_taken(driven, server, theta):
    for number, (message, said) in enumerate(_UNUSABLE, start=1):
        server.send(message)
        _says(driven, f"cannot be used: {said}")
        server.send(_theta_message(number, theta[number]))
        _shows(driven, theta[number])
        _says(driven, f"{number} messages could not be used")


def test_what_no_person_can_do_is_refused(driven, server, theta):
    far = theta[0].clone()
    far[-1] = 1024
    server.send(_theta_message(0, far))
    _says(driven, "is 1024; expected at most 100")
    server.send(_theta_message(1, theta[1]))
    assert server.received.get(timeout=20) == {"type": "shown", "index": 1}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": 2}, 'it speaks another version, the text "rgbavatar-drive" 2'),
        ({"format": "else"}, 'another version, the text "else" 1'),
        (
            {"layout": [{"name": "expression", "size": 9, "form": "linear"}]},
            "another head (theta of 9",
        ),
        ({"layout": [None, 3]}, "another head"),
        ({"layout": "x"}, "another head (theta of ?"),
    ],
    ids=range(5),
)
def test_another_head_or_version_is_told_and_its_messages_are_ignored(
    open_page, server, avatar, theta, changes, said
):
    page = open_page(f"?ws=ws://127.0.0.1:{server.port}")
    server.wait_for_page()
    before = page.evaluate("() => avatar.theta")
    server.send(hello(avatar, **changes))
    _says(page, said)
    server.send(_theta_message(0, theta[0]))
    page.evaluate("() => new Promise((done) => setTimeout(done, 200))")
    assert page.evaluate("() => avatar.theta") == before
    _says(page, said)
    server.send(hello(avatar), _theta_message(1, theta[1]))
    _shows(page, theta[1])


def test_a_server_that_does_not_greet_is_told(open_page, server, theta):
    page = open_page(f"?ws=ws://127.0.0.1:{server.port}")
    server.wait_for_page()
    server.send(_theta_message(0, theta[0]))
    _says(page, 'its first message is no "hello"')


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("ws://evil.example:8765", "this page is not driven from ws://evil.example:8765"),
        ("ws://drive.example:8766", "or ws://drive.example:8765"),
        ("http://127.0.0.1:8765", "this page is not driven from http://127.0.0.1:8765"),
        ("nonsense", "?ws=nonsense is no address; expected ws://127.0.0.1:PORT"),
    ],
    ids=["stranger", "port", "scheme", "nonsense"],
)
def test_an_address_that_may_not_drive_is_refused(open_page, address, said):
    page = open_page(f"?ws={address}")
    _says(page, said)
    assert page.evaluate("() => app.connection") is None


def test_the_browser_itself_keeps_the_page_from_other_servers(open_page, server):
    page = open_page()
    told = page.evaluate(
        """() => new Promise((done) => {
          document.addEventListener("securitypolicyviolation", (e) => done(e.effectiveDirective));
          try { new WebSocket("ws://evil.example:1"); } catch (error) { done(error.name); }
        })"""
    )
    assert told == "connect-src"
    named = page.evaluate(
        """port => new Promise((done) => {
          const socket = new WebSocket(`ws://localhost:${port}`);
          socket.onopen = () => done("open");
          document.addEventListener("securitypolicyviolation", () => done("refused"));
        })""",
        server.port,
    )
    assert named == "open"


def test_who_touches_the_page_goes_before_who_drives_it(driven, server, theta):
    driven.locator("#slider-jaw-open").fill("0.2")  # before anybody drives, which takes nothing
    server.send(_theta_message(0, theta[0]))
    _shows(driven, theta[0])
    assert driven.locator("#live-again").is_hidden()
    driven.locator("#slider-jaw-open").fill("0.3")
    assert driven.locator("#live-again").is_visible()
    server.send(_theta_message(1, theta[1]), {"type": "status", "text": "arrived"})
    _says(driven, "arrived")
    jaw = driven.evaluate("() => app.avatar.theta[app.avatar._fields.start.jaw]")
    assert jaw == pytest.approx(0.3, abs=0.01)
    driven.locator("#live-again").click()
    server.send(_theta_message(2, theta[2]))
    _shows(driven, theta[2])
    driven.locator("#play").click()
    driven.wait_for_function("() => avatar.performance.place > 0.5")
    server.send(_theta_message(3, theta[3]), {"type": "status", "text": "still there"})
    _says(driven, "still there")
    assert driven.evaluate("() => avatar.performance.playing")


def _around(context: Any, origin: str, name: str) -> Any:
    page = context.new_page()
    page.goto(f"{origin}/{name}")
    return page


def _inner(page: Any) -> Any:
    """The avatar's page within."""
    frame = page.frames[1]
    frame.wait_for_function("() => window.rgbavatar")
    return _ready(frame)


def test_a_page_of_a_named_origin_drives_and_is_answered(context, site, avatar, theta):
    page = _around(context, site[1][0], "around.html")
    inner = _inner(page)
    page.wait_for_function("() => answers.length === 1")
    ready = page.evaluate("() => answers[0]")
    assert (ready["type"], ready["layout"]) == ("ready", avatar.layout.to_json())
    page.evaluate("message => say(message)", _theta_message(7, theta[7]))
    _shows(inner, theta[7])
    page.wait_for_function("() => answers.length === 2")
    assert page.evaluate("() => answers[1]") == {"type": "shown", "index": 7}
    page.evaluate("() => say({ type: 'arkit', coefficients: { jawOpen: NaN, mouthSmileLeft: 1 } })")
    _shows(inner, avatar.theta_from_arkit({"mouthSmileLeft": 1.0}))
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
    page.evaluate("message => say(message)", _theta_message(0, theta[0]))
    inner.wait_for_function("() => heard > 0")
    assert inner.evaluate("() => avatar.theta") == before
    assert page.evaluate("() => answers") == []


def test_the_pages_own_origin_is_not_enough(context, site, theta):
    page = context.new_page()
    page.goto(f"{site[1][1]}/avatar.html")
    _ready(page)
    before = page.evaluate("() => avatar.theta")
    page.evaluate(
        """async (message) => {
          const heard = new Promise((done) => window.addEventListener("message", done));
          window.postMessage(message, "*");
          await heard;
        }""",
        _theta_message(0, theta[0]),
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
    _ready(page)
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
