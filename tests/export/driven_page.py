"""A page of an avatar for the tests that drive it from outside."""

from pathlib import Path
from typing import Any

import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.export import PageOptions, front_camera, write_web_page

AROUND = """<!doctype html><title>around</title>
<script>
  window.answers = [];
  window.addEventListener("message", (event) => answers.push(event.data));
  const say = (message) => document.querySelector("iframe").contentWindow.postMessage(message, "*");
</script>
<iframe src="{{page}}" width="500" height="400"></iframe>"""
"""A page around the avatar's, which keeps what it is answered."""


def write_site(folder: Path, avatar: Avatar, theta: torch.Tensor, origin: str) -> None:
    """The page, which listens to one origin, and pages around it."""
    options = PageOptions(origins=(origin,), servers=("ws://drive.example:8765",))
    camera = front_camera(avatar, 64, 64)
    write_web_page(avatar, folder / "avatar.html", camera, theta, options)
    for name in ("around.html", "stranger.html"):
        (folder / name).write_text(AROUND.replace("{{page}}", f"{origin}/avatar.html"))


def ready(page: Any) -> Any:
    """The page once its avatar is there, drawn small, which is fast."""
    page.evaluate(
        "() => rgbavatar.then((app) => { Object.assign(window, { app, avatar: app.avatar });"
        " avatar.setSize(64, 64); })"
    )
    return page


def theta_message(index: int, theta: torch.Tensor) -> dict[str, Any]:
    """What moves the avatar to a theta."""
    return {"type": "theta", "index": index, "theta": theta.double().tolist()}


def says(page: Any, text: str) -> None:
    """Wait until the page says so of its connection."""
    page.wait_for_function(
        "text => document.querySelector('#live').textContent.includes(text)",
        arg=text,
    )


def shows(page: Any, theta: torch.Tensor) -> None:
    """Wait until the avatar has this theta."""
    page.wait_for_function(
        "wanted => avatar.theta.every((value, i) => Math.abs(value - wanted[i]) < 1e-6)",
        arg=theta.double().tolist(),
    )
