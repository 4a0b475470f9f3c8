"""The module and the page drawn with WebGPU: Python's pictures, WebGL2's; and without it."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from rgbavatar_ns.export import front_camera, write_web_module, write_web_page
from rgbavatar_ns.export.avatar_file import FIRST_BYTES
from tests.browser import IN_BROWSER, chromium

from .module_page import SIZE, canvas_of, drawn_by_us, foreign_camera, load_avatar
from .subject import avatar_of, lively_theta, psnr

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


def _beside(page: Any) -> None:
    """Have WebGL2 draw the same avatar on the second canvas, as `other`."""
    page.evaluate(
        """async () => {
          window.other = await module.RGBAvatar.load(
            { data: avatar.data }, document.querySelectorAll("canvas")[1], { renderer: "webgl2" });
        }"""
    )
    assert page.evaluate("() => [avatar.rendererKind, other.rendererKind]") == ["webgpu", "webgl2"]


def test_webgpu_draws_where_there_is_one_what_render_draws(page, avatar, theta, neutral):
    assert page.evaluate("() => avatar.rendererKind") == "webgpu"
    shown = canvas_of(page)
    assert psnr(shown[..., :3], drawn_by_us(avatar, neutral)[0]) > 45
    assert (shown[..., 3] == 1).all()
    for numbers in theta[:3]:
        _set(page, numbers)
        assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, numbers)[0]) > 45


def test_another_programs_camera_sees_what_render_draws_from_there(page, avatar, theta):
    cameras, view, projection = foreign_camera(SIZE, SIZE)
    _set(page, theta[0])
    page.evaluate(
        "([view, projection]) => avatar.setCamera("
        "module.RGBAvatar.openGLCamera(view, projection, 48, 48))",
        [view, projection],
    )
    ours = drawn_by_us(avatar, theta[0], cameras)[0]
    assert ours.std() > 0.1
    assert psnr(canvas_of(page)[..., :3], ours) > 45


def test_a_transparent_picture_has_the_renderers_alpha(page, avatar, theta):
    _set(page, theta[0])
    page.evaluate("() => { avatar.background = null; }")
    shown = canvas_of(page)
    picture, alpha = drawn_by_us(avatar, theta[0])
    assert alpha.min() == 0
    assert alpha.max() > 0.9
    assert psnr(shown[..., 3:], alpha) > 45
    on_white = shown[..., :3] * shown[..., 3:] + (1 - shown[..., 3:])
    assert psnr(on_white, picture) > 40  # colours divided by small alphas come back rounded


def test_both_renderers_draw_the_same(page, theta):
    _beside(page)
    whole = canvas_of(page)
    for change in (
        f"setTheta({theta[1].double().tolist()})",
        "holdWeight(2, 1.5)",
        "detail = 0.5",
        "orbit(0.4, 0.1)",
        "camera.zoom(4)",
        "setSize(70, 111)",
        "background = [0.1, 0.5, 0.9]",
        "background = null",
    ):
        page.evaluate(f"() => {{ for (const one of [avatar, other]) one.{change}; }}")
        seen = canvas_of(page)
        assert psnr(seen, canvas_of(page, "other")) > 50, change
    assert seen.shape != whole.shape


@pytest.mark.parametrize(
    "share",
    [
        {"detail": 1, "resolution": 1, "bytes": True},
        {"detail": 1, "resolution": 0.5, "bytes": False},
    ],
    ids=["bytes", "half the pixels"],
)
def test_both_renderers_leave_out_the_same_while_something_moves(page, share):
    _beside(page)
    whole = canvas_of(page)
    script = "share => { for (const one of [avatar, other]) one.draw = () => one._draw(share); }"
    page.evaluate(script, share)
    seen = canvas_of(page)
    assert not np.array_equal(seen, whole)
    assert psnr(seen, canvas_of(page, "other")) > 50


@pytest.mark.parametrize(
    "changes",
    [
        {"tangent_variant": "orthonormal", "scale_with_triangle": True},
        {"tangent_variant": "raw", "carrier": "joints", "weight_network": "none"},
        {"num_bases": 0},
    ],
    ids=["orthonormal", "raw", "base"],
)
def test_other_avatars_are_drawn_as_render_draws_them(bare_page, folder, changes):
    avatar = avatar_of(**changes)
    numbers = lively_theta(avatar, 2)
    write_web_module(avatar, folder / "another", front_camera(avatar, SIZE, SIZE), numbers)
    load_avatar(bare_page, file="another/avatar.rgba")
    assert bare_page.evaluate("() => avatar.rendererKind") == "webgpu"
    _set(bare_page, numbers[1])
    assert psnr(canvas_of(bare_page)[..., :3], drawn_by_us(avatar, numbers[1])[0]) > 45


def test_what_arrives_is_drawn(bare_page, folder):
    avatar = avatar_of(uv_resolution=128)  # enough Gaussians for several parts
    numbers = lively_theta(avatar, 1)
    write_web_module(avatar, folder / "large", front_camera(avatar, SIZE, SIZE), numbers)
    bare_page.evaluate(
        """async (first) => {
          const file = await (await fetch("large/avatar.rgba")).arrayBuffer();
          const source = new ReadableStream({
            start(controller) {
              controller.enqueue(new Uint8Array(file, 0, first));
              window.goOn = () => {
                controller.enqueue(new Uint8Array(file, first));
                controller.close();
              };
            },
          });
          window.avatar = await module.RGBAvatar.load(source, document.querySelector("canvas"));
        }""",
        FIRST_BYTES + 100,
    )
    _beside(bare_page)
    available = bare_page.evaluate("() => avatar.data.available")
    assert 1000 < available < 0.8 * avatar.num_gaussians
    _set(bare_page, numbers[0])
    bare_page.evaluate("numbers => other.setTheta(numbers)", numbers[0].double().tolist())
    coarse, ours = canvas_of(bare_page), drawn_by_us(avatar, numbers[0])[0]
    assert psnr(coarse, canvas_of(bare_page, "other")) > 50
    assert 20 < psnr(coarse[..., :3], ours) < 45
    bare_page.evaluate("() => { goOn(); return avatar.complete; }")
    assert psnr(canvas_of(bare_page)[..., :3], ours) > 45


def test_disposing_frees_the_device_and_another_may_draw(page, avatar, neutral):
    page.evaluate("() => { window.gone = avatar; avatar.dispose(); avatar.dispose(); }")
    assert page.evaluate("() => devices[0].lost.then(({ reason }) => reason)") == "destroyed"
    pictures = page.evaluate("() => { gone.setSize(50, 60); gone.draw(); return gone.pictures; }")
    load_avatar(page)
    assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, neutral)[0]) > 45
    assert page.evaluate("() => [gone.pictures, devices.length]") == [pictures, 2]


def test_a_lost_device_is_told_and_the_picture_comes_back(page, avatar, neutral):
    page.evaluate(
        """() => {
          window.events = [];
          for (const name of ["lost", "restored"]) {
            avatar.addEventListener(name, () => events.push(name));
          }
          const { gpu } = navigator, request = gpu.requestAdapter.bind(gpu);
          let refusals = 1; // the driver takes its time
          gpu.requestAdapter = (...given) => (refusals-- > 0 ? null : request(...given));
        }"""
    )
    wanted = neutral + avatar.theta_from_arkit({"jawOpen": 1.0})
    for again in range(2):  # the second device, too
        page.evaluate("() => { events.length = 0; devices.at(-1).destroy(); }")
        page.wait_for_function("() => events.includes('lost')")
        page.evaluate("() => { avatar.setARKit({ jawOpen: 1 }); avatar.draw(); }")
        page.wait_for_function("() => events.includes('restored')")
        assert page.evaluate("() => [events, devices.length]") == [["lost", "restored"], again + 2]
        assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, wanted)[0]) > 45


_WITHOUT = {
    "no WebGPU": "Object.defineProperty(navigator, 'gpu', { value: undefined });",
    "no adapter": "navigator.gpu.requestAdapter = async () => null;",
    "no device": "GPUAdapter.prototype.requestDevice = async () => { throw new Error('busy'); };",
    "no program": "GPUDevice.prototype.createComputePipelineAsync = async () => {"
    " throw new Error('refused'); };",
    "no memory": """const make = GPUDevice.prototype.createBuffer;
      GPUDevice.prototype.createBuffer = function (asked) {
        return make.call(this, { ...asked, size: 2 * this.limits.maxBufferSize });
      };""",
}


@pytest.mark.parametrize("lacking", _WITHOUT)
def test_without_webgpu_the_picture_is_webgl2s(bare_page, avatar, neutral, lacking):
    bare_page.evaluate(f"() => {{ {_WITHOUT[lacking]} }}")
    load_avatar(bare_page)
    assert bare_page.evaluate("() => avatar.rendererKind") == "webgl2"
    assert psnr(canvas_of(bare_page)[..., :3], drawn_by_us(avatar, neutral)[0]) > 45


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ("'vulkan'", 'RangeError: renderer is the text "vulkan"; expected "webgpu" or "webgl2".'),
        ("'webgpu'", "Error: This browser has no WebGPU."),
    ],
)
def test_a_renderer_that_cannot_be_is_told(bare_page, wanted, said):
    bare_page.evaluate("() => { navigator.gpu.requestAdapter = async () => null; }")
    told = bare_page.evaluate(
        "() => module.RGBAvatar.load('avatar.rgba', document.querySelector('canvas'),"
        f" {{ renderer: {wanted} }}).then(() => '', (error) => `${{error}}`)"
    )
    assert told == said


@pytest.mark.parametrize(("query", "kind"), [("", "webgpu"), ("?renderer=webgl2", "webgl2")])
def test_the_pages_address_can_name_the_renderer(bare_page, avatar, theta, tmp_path, query, kind):
    file = tmp_path / "avatar.html"
    write_web_page(avatar, file, front_camera(avatar, SIZE, SIZE), theta)
    bare_page.goto(file.as_uri() + query)
    found = bare_page.evaluate(
        """size => rgbavatar.then((app) => {
          window.avatar = app.avatar;
          avatar.setSize(size, size);
          return avatar.complete.then(() => avatar.rendererKind);
        })""",
        SIZE,
    )
    assert found == kind
    _set(bare_page, theta[0])
    assert psnr(canvas_of(bare_page)[..., :3], drawn_by_us(avatar, theta[0])[0]) > 45
