"""Shared by the tests of the module and of pages that are driven from outside."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.export import front_camera, write_web_module
from tests.browser import chromium

from .driven_page import ready, write_site
from .local_site import served
from .module_page import PAGE, SIZE, load_avatar
from .subject import avatar_of, lively_theta


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return avatar_of()


@pytest.fixture(scope="module")
def theta(avatar) -> torch.Tensor:
    return lively_theta(avatar, 40)


@pytest.fixture(scope="module")
def site(avatar, theta, tmp_path_factory) -> Iterator[Any]:
    """A folder with the page on two servers, so two origins; the page listens to the first."""
    folder = tmp_path_factory.mktemp("site")
    with served(folder) as named, served(folder) as stranger:
        write_site(folder, avatar, theta, named)
        yield folder, (named, stranger)


@pytest.fixture
def context(browser) -> Iterator[Any]:
    """A window as wide as a desk's and, for speed, low; errors in a page fail the test."""
    context = browser.new_context(viewport={"width": 800, "height": 200})
    problems: list[str] = []
    context.on("weberror", lambda error: problems.append(str(error.error)))
    yield context
    context.close()
    assert not problems


@pytest.fixture
def open_page(context, site) -> Any:
    """Opens the page from the disk, with a query."""

    def show(query: str = "") -> Any:
        page = context.new_page()
        page.goto((site[0] / "avatar.html").as_uri() + query)
        return ready(page)

    return show


@pytest.fixture(scope="module")
def neutral(avatar) -> torch.Tensor:
    return 0.3 * lively_theta(avatar, 1, seed=5)[0]


@pytest.fixture(scope="module")
def folder(avatar, theta, neutral, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("module") / "site"
    camera = front_camera(avatar, SIZE, SIZE)
    write_web_module(avatar, folder, camera, theta, neutral=neutral)
    (folder / "page.html").write_text(PAGE)
    return folder


@pytest.fixture(scope="module")
def origin(folder) -> Iterator[str]:
    with served(folder) as origin:
        yield origin


@pytest.fixture
def bare_page(browser, origin) -> Iterator[Any]:
    """A page with the module and two canvases; what goes wrong in it fails the test."""
    context = browser.new_context(viewport={"width": 400, "height": 300})
    problems: list[str] = []
    context.on("weberror", lambda error: problems.append(str(error.error)))
    page = context.new_page()
    page.goto(f"{origin}/page.html")
    yield page
    context.close()
    assert not problems


@pytest.fixture
def page(bare_page) -> Any:
    """With an avatar on the first canvas, as `avatar`."""
    load_avatar(bare_page)
    return bare_page
