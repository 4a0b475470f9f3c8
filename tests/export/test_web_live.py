"""The page driven over a WebSocket, in a browser: what it follows, answers, tells and refuses."""

import time
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from rgbavatar_ns.driving.live_drive import DrivenFrame
from rgbavatar_ns.export.live_page import PageOutput
from tests.browser import IN_BROWSER

from .drive_server import DriveServer, hello
from .driven_page import says, shows, theta_message

pytestmark = IN_BROWSER


@pytest.fixture
def server() -> Iterator[DriveServer]:
    server = DriveServer()
    yield server
    server.close()


@pytest.fixture
def driven(open_page, server, avatar) -> Any:
    """A page that a server drives."""
    page = open_page(f"?ws=ws://127.0.0.1:{server.port}")
    server.wait_for_page()
    server.send(hello(avatar))
    says(page, f"connected to 127.0.0.1:{server.port}")
    return page


def test_every_drawn_message_is_answered_and_the_newest_wins(driven, server, theta):
    server.send(theta_message(3, theta[3]))
    assert server.received.get(timeout=20) == {"type": "shown", "index": 3}
    shows(driven, theta[3])
    server.send(*[theta_message(10 + i, theta[i]) for i in range(20)])
    shows(driven, theta[19])
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
    shows(driven, wanted)
    server.send({"type": "status", "text": "<b>calibrating</b>"})
    says(driven, ": <b>calibrating</b>")
    assert driven.locator("#live b").count() == 0


def test_the_projects_own_server_drives_the_page_and_hears_of_it(open_page, avatar, theta):
    output = PageOutput(avatar.layout, "127.0.0.1:0")
    page = open_page(f"?ws=ws://{output.keyed_address}")
    output.show(DrivenFrame(3, theta[3], time.monotonic(), 0.1))
    shows(page, theta[3])
    page.wait_for_function("() => avatar.pictures > 1")
    while output.latencies.shown == 0:
        time.sleep(0.01)
    output.close()
    says(page, "The performance has ended, trying again in")


def test_whoever_performs_can_be_calibrated_from_the_page(driven, server):
    driven.locator("#calibrate").click()
    assert server.received.get(timeout=20) == {"type": "calibrate"}
    driven.locator("#view").press("c")
    assert server.received.get(timeout=20) == {"type": "calibrate"}


def test_a_lost_connection_is_told_and_comes_back(open_page, avatar, theta):
    first = DriveServer()
    page = open_page(f"?ws=ws://127.0.0.1:{first.port}")
    first.wait_for_page()
    first.send(hello(avatar), theta_message(0, theta[0]))
    shows(page, theta[0])
    first.close()
    says(page, "connection lost, trying again in 1 s")
    says(page, "no answer from")
    says(page, "trying again in 2 s")
    assert page.locator("#live.problem").count() == 1
    assert page.locator("#calibrate").is_hidden()
    shows(page, theta[0])
    second = DriveServer(first.port)
    second.wait_for_page()
    second.send(hello(avatar), theta_message(0, theta[1]))
    shows(page, theta[1])
    says(page, "connected to")
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
        says(driven, f"cannot be used: {said}")
        server.send(theta_message(number, theta[number]))
        shows(driven, theta[number])
        says(driven, f"{number} messages could not be used")


def test_what_no_person_can_do_is_refused(driven, server, theta):
    far = theta[0].clone()
    far[-1] = 1024
    server.send(theta_message(0, far))
    says(driven, "is 1024; expected at most 100")
    server.send(theta_message(1, theta[1]))
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
    says(page, said)
    server.send(theta_message(0, theta[0]))
    page.evaluate("() => new Promise((done) => setTimeout(done, 200))")
    assert page.evaluate("() => avatar.theta") == before
    says(page, said)
    server.send(hello(avatar), theta_message(1, theta[1]))
    shows(page, theta[1])


def test_a_server_that_does_not_greet_is_told(open_page, server, theta):
    page = open_page(f"?ws=ws://127.0.0.1:{server.port}")
    server.wait_for_page()
    server.send(theta_message(0, theta[0]))
    says(page, 'its first message is no "hello"')


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
    says(page, said)
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
    server.send(theta_message(0, theta[0]))
    shows(driven, theta[0])
    assert driven.locator("#live-again").is_hidden()
    driven.locator("#slider-jaw-open").fill("0.3")
    assert driven.locator("#live-again").is_visible()
    server.send(theta_message(1, theta[1]), {"type": "status", "text": "arrived"})
    says(driven, "arrived")
    jaw = driven.evaluate("() => app.avatar.theta[app.avatar._fields.start.jaw]")
    assert jaw == pytest.approx(0.3, abs=0.01)
    driven.locator("#live-again").click()
    server.send(theta_message(2, theta[2]))
    shows(driven, theta[2])
    driven.locator("#play").click()
    driven.wait_for_function("() => avatar.performance.place > 0.5")
    server.send(theta_message(3, theta[3]), {"type": "status", "text": "still there"})
    says(driven, "still there")
    assert driven.evaluate("() => avatar.performance.playing")
