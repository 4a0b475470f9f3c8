"""The ES module in a real browser: Python's pictures, whoever drives, whoever's camera."""

import base64
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from rgbavatar_ns.avatar import Avatar
from rgbavatar_ns.export import draw, front_camera, write_web_module
from rgbavatar_ns.kernels import PinholeCameras
from tests.browser import IN_BROWSER, chromium

from .local_site import served
from .subject import avatar_of, lively_theta, psnr

pytestmark = IN_BROWSER
_SIZE = 96
_PAGE = """<!doctype html>
<style>canvas { width: 96px; height: 96px; display: block; }</style>
<canvas></canvas><canvas></canvas>
<script type="module">
  import * as module from "./rgbavatar.js";
  window.module = module;
</script>"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def avatar() -> Avatar:
    return avatar_of()


@pytest.fixture(scope="module")
def theta(avatar) -> torch.Tensor:
    return lively_theta(avatar, 3)


@pytest.fixture(scope="module")
def neutral(avatar) -> torch.Tensor:
    return 0.3 * lively_theta(avatar, 1, seed=5)[0]


@pytest.fixture(scope="module")
def folder(avatar, theta, neutral, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("module") / "site"
    camera = front_camera(avatar, _SIZE, _SIZE)
    write_web_module(avatar, folder, camera, theta, neutral=neutral)
    (folder / "page.html").write_text(_PAGE)
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
    _load(bare_page)
    return bare_page


def _load(page: Any, options: str = "{}") -> None:
    page.evaluate(
        "async () => { window.avatar = await module.RGBAvatar.load('avatar.rgba',"
        f" document.querySelector('canvas'), {options}); await avatar.complete; }}"
    )


def _shown(page: Any, name: str = "avatar") -> np.ndarray:
    """The canvas [H, W, 4] with straight alpha in [0, 1], drawn now."""
    text = page.evaluate(f"() => {{ {name}.draw(); return {name}.canvas.toDataURL('image/png'); }}")
    image = Image.open(io.BytesIO(base64.b64decode(text.split(",")[1])))
    return np.asarray(image.convert("RGBA")).astype(np.float32) / 255


def _ours(
    avatar: Avatar, theta: torch.Tensor, cameras: PinholeCameras | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The picture on white, and its alpha; theta: one."""
    cameras = front_camera(avatar, _SIZE, _SIZE) if cameras is None else cameras
    drawn = draw(avatar, theta[None], cameras, (1.0, 1.0, 1.0))
    return drawn.image[0].clamp(0, 1).numpy(), drawn.alpha[0].numpy()


def test_at_first_the_calm_face_is_shown_as_render_draws_it(page, avatar, neutral):
    shown = _shown(page)
    assert psnr(shown[..., :3], _ours(avatar, neutral)[0]) > 45
    assert (shown[..., 3] == 1).all()
    assert page.evaluate("() => avatar.neutralTheta") == pytest.approx(neutral.tolist(), abs=1e-6)
    assert page.evaluate("() => avatar.layout") == avatar.layout.to_json()
    names = page.evaluate("() => avatar.expressionNames")
    assert tuple(names) == avatar.head.arrays.expression_names


def test_a_theta_is_shown_as_render_draws_it(page, avatar, theta):
    for numbers, kind in (
        (theta[0], "Float32Array"),
        (theta[1], "Float64Array"),
        (theta[2], "Array"),
    ):
        script = f"numbers => avatar.setTheta({kind}.from(numbers))"
        page.evaluate(script, numbers.double().tolist())
        assert psnr(_shown(page)[..., :3], _ours(avatar, numbers)[0]) > 45


def test_arkit_is_shown_as_avatar_theta_from_arkit_is_drawn(page, avatar, neutral):
    turn = [0.1, -0.3, 0.05]
    page.evaluate(
        """turn => avatar.setARKit({ jawOpen: 0.6, mouthSmileLeft: 0.8, EyeBlinkRight: 1,
          mouthPucker: -3, browInnerUp: 5, cheekPuff: NaN },
          { rotation: turn, translation: [0.01, -0.02, 0.03] })""",
        turn,
    )
    named = {"jawOpen": 0.6, "mouthSmileLeft": 0.8, "eyeBlinkRight": 1.0, "browInnerUp": 1.0}
    wanted = neutral + avatar.theta_from_arkit(named)
    wanted[avatar.layout.slice(avatar.arkit.turns)] = torch.tensor(turn)
    wanted[avatar.layout.slice("translation")] += torch.tensor([0.01, -0.02, 0.03])
    assert page.evaluate("() => avatar.theta") == pytest.approx(wanted.tolist(), abs=1e-5)
    assert psnr(_shown(page)[..., :3], _ours(avatar, wanted)[0]) > 45
    page.evaluate("() => avatar.setARKit({})")
    assert page.evaluate("() => avatar.theta") == pytest.approx(neutral.tolist(), abs=1e-6)


def test_unknown_names_are_told_once(page):
    told: list[str] = []
    page.on("console", lambda message: told.append(message.text))
    page.evaluate("() => { for (let i = 0; i < 3; i++) avatar.setARKit({ smile: 1, tongue: 1 }); }")
    assert len(told) == 2
    assert 'ARKit has no blend shape "smile"' in told[0]


def _foreign_camera(width: int, height: int) -> tuple[PinholeCameras, list[float], list[float]]:
    """A camera beside the head, with its view and projection matrices as OpenGL has them."""
    right = np.array([0.9, 0.0, -0.4]) / np.hypot(0.9, 0.4)
    up = np.array([0.0, 1.0, 0.0])
    backward = np.cross(right, up)
    view = np.eye(4)
    view[:3, :3] = np.stack([right, up, backward])
    view[:3, 3] = -view[:3, :3] @ (0.9 * backward + [0.01, 0.02, 0.03])
    near, far, scale = 0.1, 10.0, 3.1
    projection = np.zeros((4, 4))
    projection[0] = [scale * height / width, 0, 0.1, 0]
    projection[1] = [0, scale, -0.2, 0]
    projection[2] = [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)]
    projection[3, 2] = -1

    # By hand: a pixel is (x' + 1) w / 2, (1 - y') h / 2 of the projected point (x', y').
    def pixel(point: np.ndarray) -> np.ndarray:
        clip = projection @ view @ np.append(point, 1)
        x, y = clip[:2] / clip[3]
        return np.array([(x + 1) * width / 2, (1 - y) * height / 2])

    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0]) @ view
    origin = np.linalg.inv(view)[:3, 3]
    centre = pixel(origin - backward)
    focal = (
        pixel(origin - backward + right)[0] - centre[0],
        centre[1] - pixel(origin - backward + up)[1],
    )
    cameras = PinholeCameras(
        torch.from_numpy(world_to_camera)[None].float(),
        torch.tensor([focal], dtype=torch.float32),
        torch.from_numpy(centre)[None].float(),
        width,
        height,
    )
    return cameras, view.T.flatten().tolist(), projection.T.flatten().tolist()


def test_another_programs_camera_sees_what_render_draws_from_there(page, avatar, theta):
    cameras, view, projection = _foreign_camera(_SIZE, _SIZE)
    page.evaluate("numbers => avatar.setTheta(numbers)", theta[0].double().tolist())
    # For a picture of half the size, which is stretched.
    page.evaluate(
        "([view, projection]) => avatar.setCamera("
        "module.RGBAvatar.openGLCamera(view, projection, 48, 48))",
        [view, projection],
    )
    ours = _ours(avatar, theta[0], cameras)[0]
    assert ours.std() > 0.1
    assert psnr(_shown(page)[..., :3], ours) > 45
    page.evaluate("() => avatar.setCamera(null)")
    assert psnr(_shown(page)[..., :3], _ours(avatar, theta[0])[0]) > 45


def test_a_transparent_picture_has_the_renderers_alpha(page, avatar, theta):
    page.evaluate("numbers => avatar.setTheta(numbers)", theta[0].double().tolist())
    page.evaluate("() => { avatar.background = null; }")
    shown = _shown(page)
    picture, alpha = _ours(avatar, theta[0])
    assert alpha.min() == 0
    assert alpha.max() > 0.9
    assert psnr(shown[..., 3:], alpha) > 45
    on_white = shown[..., :3] * shown[..., 3:] + (1 - shown[..., 3:])
    assert psnr(on_white, picture) > 40  # colours divided by small alphas come back rounded


def test_orbiting_is_held_where_the_avatar_holds(page):
    page.evaluate("() => avatar.orbit(0.3, -0.1)")
    assert page.evaluate("() => avatar.camera.angles()") == pytest.approx([0.3, -0.1])
    page.evaluate("() => avatar.orbit(9, 0)")
    (yaw, _) = page.evaluate("() => { avatar.draw(); return avatar.turnSeen; }")
    high = page.evaluate("() => avatar.data.manifest.film.turn_reach[1][0]")
    assert yaw == pytest.approx(high, abs=1e-3)


def test_the_performance_plays_and_a_theta_pauses_it(page, theta):
    page.evaluate("() => avatar.performance.play()")
    page.wait_for_function("() => avatar.performance.place > 0.2")
    page.evaluate("numbers => avatar.setTheta(numbers)", theta[0].double().tolist())
    assert not page.evaluate("() => avatar.performance.playing")
    page.evaluate("() => avatar.performance.seek(2)")
    assert page.evaluate("() => avatar.theta") == pytest.approx(theta[2].tolist(), abs=1e-5)


_REFUSED = (
    ("setTheta([1, 2])", "RangeError", "theta has 2 numbers; expected"),
    ("setTheta()", "TypeError", "theta is undefined; expected"),
    ("setTheta('abc')", "TypeError", 'theta is the text "abc"'),
    ("setTheta(avatar.theta.fill(NaN))", "RangeError", "theta[0] is NaN; expected a finite"),
    ("setTheta(avatar.theta.fill('1'))", "TypeError", 'theta[0] is the text "1"'),
    ("setTheta(avatar.theta.fill(1e5))", "RangeError", "(expression) is 100000"),
    ("setARKit(3)", "TypeError", "The coefficients are 3"),
    ("setARKit({}, { rotation: [1, 2] })", "RangeError", "pose.rotation has 2 numbers"),
    ("setARKit({}, { translation: [NaN, 0, 0] })", "RangeError", "pose.translation[0] is NaN"),
    ("setARKit({}, 5)", "TypeError", "The pose is 5"),
    ("orbit(NaN, 0)", "RangeError", "[yaw, pitch][0] is NaN"),
    ("setCamera({})", "TypeError", "camera.rotation is undefined"),
    ("setCamera(7)", "TypeError", "The camera is 7"),
    ("setCamera({ rotation: new Array(9).fill(1) })", "RangeError", "not orthonormal"),
    ("holdWeight(99, 1)", "RangeError", "k is 99; expected 0 to 3"),
    ("setSize(NaN, 3)", "RangeError", "[width, height][0] is NaN"),
    ("background = [1, 2]", "RangeError", "background has 2 numbers"),
)


def test_what_is_none_is_told_and_changes_nothing(page):
    before = page.evaluate("() => [avatar.theta, avatar.background]")
    for call, kind, said in _REFUSED:
        told = page.evaluate(
            f"() => {{ try {{ avatar.{call}; }}"
            " catch (error) { return [error.name, error.message]; } }"
        )
        assert told[0] == kind
        assert said in told[1]
    assert page.evaluate("() => [avatar.theta, avatar.background]") == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("'none.rgba', document.querySelector('canvas')", "none.rgba cannot be loaded: status 404"),
        ("3, document.querySelector('canvas')", "source is 3; expected an address"),
        ("'avatar.rgba', document.body", "canvas is of type object; expected a canvas"),
    ],
    ids=["address", "source", "canvas"],
)
def test_what_cannot_be_loaded_is_told(bare_page, arguments, said):
    told = bare_page.evaluate(
        f"() => module.RGBAvatar.load({arguments}).then(() => '', (error) => error.message)"
    )
    assert said in told


def test_a_file_that_is_cut_off_is_told_and_what_is_there_stays(bare_page, folder):
    whole = (folder / "avatar.rgba").read_bytes()
    (folder / "cut.rgba").write_bytes(whole[:-5])
    told = bare_page.evaluate(
        """async () => {
          window.avatar = await module.RGBAvatar.load("cut.rgba", document.querySelector("canvas"));
          return avatar.complete.then(() => "", (error) => error.message);
        }"""
    )
    assert told == f"The avatar's file is cut off after {len(whole) - 5} bytes."
    assert _shown(bare_page)[..., :3].std() > 0.1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda whole: b"<!doctype html>" + whole, "This is no avatar's file."),
        (lambda whole: whole[:8] + b"\x09" + whole[9:], "The avatar's file has version 9;"),
        (lambda whole: whole[:500], "The avatar's file is cut off after 500 bytes."),
        (lambda whole: whole[:99] + b"x" + whole[100:], "The avatar's file is damaged."),
        (lambda whole: b"", "The avatar's file is cut off after 0 bytes."),
    ],
    ids=["another", "version", "short", "damaged", "empty"],
)
def test_what_is_no_avatars_file_is_told(bare_page, folder, change, said):
    (folder / "odd.rgba").write_bytes(change((folder / "avatar.rgba").read_bytes()))
    told = bare_page.evaluate(
        "() => module.RGBAvatar.load('odd.rgba', document.querySelector('canvas'))"
        ".then(() => '', (error) => error.message)"
    )
    assert told.startswith(said)


def test_disposing_frees_the_graphics_memory_and_another_may_draw(bare_page, avatar, neutral):
    bare_page.evaluate(
        """() => {
          window.objects = new Set();
          const gl = WebGL2RenderingContext.prototype;
          for (const kind of [
            "Texture", "Buffer", "Framebuffer", "VertexArray", "Program", "Shader",
          ]) {
            const [make, free] = [gl[`create${kind}`], gl[`delete${kind}`]];
            gl[`create${kind}`] = function (...given) {
              const made = make.apply(this, given);
              objects.add(made);
              return made;
            };
            gl[`delete${kind}`] = function (made) { objects.delete(made); free.call(this, made); };
          }
        }"""
    )
    _load(bare_page)
    bare_page.evaluate("() => { avatar.setSize(50, 60); avatar.draw(); avatar.setSize(); }")
    assert bare_page.evaluate("() => objects.size") > 10
    bare_page.evaluate("() => { window.gone = avatar; avatar.dispose(); avatar.dispose(); }")
    assert bare_page.evaluate("() => objects.size") == 0
    pictures = bare_page.evaluate(
        "() => { gone.setARKit({ jawOpen: 1 }); gone.draw(); return gone.pictures; }"
    )
    _load(bare_page)
    assert psnr(_shown(bare_page)[..., :3], _ours(avatar, neutral)[0]) > 45
    assert bare_page.evaluate("() => gone.pictures") == pictures


def test_a_lost_context_is_told_and_the_picture_comes_back(page, avatar, neutral):
    page.evaluate(
        """() => {
          window.events = [];
          for (const name of ["lost", "restored"]) {
            avatar.addEventListener(name, () => events.push(name));
          }
          window.taking = avatar.canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
          taking.loseContext();
        }"""
    )
    page.wait_for_function("() => events.includes('lost')")
    page.evaluate(
        "() => { avatar.setARKit({ jawOpen: 1 }); avatar.draw(); taking.restoreContext(); }"
    )
    page.wait_for_function("() => events.includes('restored')")
    wanted = neutral + avatar.theta_from_arkit({"jawOpen": 1.0})
    assert psnr(_shown(page)[..., :3], _ours(avatar, wanted)[0]) > 45


def test_two_canvases_share_the_data_and_draw_apart(page, avatar, neutral, theta):
    page.evaluate(
        """async (numbers) => {
          window.other = await module.RGBAvatar.load({ data: avatar.data },
            document.querySelectorAll("canvas")[1], { background: [1, 1, 1], automatic: false });
          avatar.setTheta(numbers);
        }""",
        theta[0].double().tolist(),
    )
    assert psnr(_shown(page, "other")[..., :3], _ours(avatar, neutral)[0]) > 45
    assert psnr(_shown(page)[..., :3], _ours(avatar, theta[0])[0]) > 45


def test_the_types_name_what_the_module_has(page, folder):
    types = (folder / "rgbavatar.d.ts").read_text()
    body = types[types.index("export class RGBAvatar") :]
    plain = re.sub(r"/\*\*.*?\*/", "", body, flags=re.DOTALL)
    found = re.findall(r"^  (?:(static|get|set|readonly) )?(\w+)\s*[(:]", plain, re.MULTILINE)
    declared = {name for kind, name in found if kind != "static"}
    static = {name for kind, name in found if kind == "static"}
    there = page.evaluate(
        """() => {
          const open = (names) => names.filter((name) => !name.startsWith("_"));
          const own = open(Object.getOwnPropertyNames(avatar));
          return [[...own, ...open(Object.getOwnPropertyNames(module.RGBAvatar.prototype))],
            open(Object.getOwnPropertyNames(module.RGBAvatar)), Object.keys(module)];
        }"""
    )
    # The orbit camera is the page's, whose pointers and keys turn it step by step.
    assert declared == set(there[0]) - {"camera", "constructor"}
    assert static == set(there[1]) - {"length", "name", "prototype"}
    assert there[2] == ["RGBAvatar"]
    performance = types[types.index("export interface Performance") :].split("}")[0]
    members = re.findall(r"^  (?:readonly )?(\w+)\s*[(:]", performance, re.MULTILINE)
    assert all(page.evaluate("names => names.map((name) => name in avatar.performance)", members))


def test_the_smallest_example_runs(browser, origin):
    page = browser.new_page(viewport={"width": 300, "height": 300})
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(f"{origin}/example.html")
    page.wait_for_function("() => document.querySelector('canvas').width > 100")
    before = page.screenshot()
    page.locator("input").fill("1")
    page.mouse.move(280, 20)
    page.wait_for_timeout(500)
    assert page.screenshot() != before
    assert not problems
    page.close()


_LANDMARKER = """
export const FilesetResolver = { forVisionTasks: async (files) => files };
export const FaceLandmarker = {
  createFromOptions: async (files, options) => ({
    detectForVideo: () => ({
      faceBlendshapes: options.outputFaceBlendshapes ? [{ categories: [
        { categoryName: "_neutral", score: 1 }, { categoryName: "jawOpen", score: 0.75 }] }] : [],
      facialTransformationMatrixes: options.outputFacialTransformationMatrixes
        ? [{ rows: 4, columns: 4, data: %s }] : [],
    }),
  }),
};"""


def test_in_mediapipes_example_its_scores_and_matrix_move_the_avatar(
    browser, origin, folder, avatar, neutral
):
    # A turn of .2 about y at 50 cm before the camera, column by column.
    cos, sin = np.cos(0.2), np.sin(0.2)
    matrix = [cos, 0, -sin, 0, 0, 1, 0, 0, sin, 0, cos, 0, 0, 0, -50, 1]
    page = browser.new_page(viewport={"width": 300, "height": 300})
    page.route(
        re.compile(
            "^https://cdn.jsdelivr.net/npm/@mediapipe/tasks-vision@[0-9.]+/vision_bundle.mjs$"
        ),
        lambda route: route.fulfill(
            body=_LANDMARKER % [float(v) for v in matrix],
            content_type="text/javascript",
            headers={"Access-Control-Allow-Origin": "*"},
        ),
    )
    page.add_init_script(
        """navigator.mediaDevices.getUserMedia = async () => {
          const canvas = document.createElement("canvas"), drawn = canvas.getContext("2d");
          setInterval(() => drawn.fillRect(0, 0, 9, 9), 30);
          return canvas.captureStream(30);
        };"""
    )
    page.goto(f"{origin}/example-mediapipe.html")
    page.evaluate(
        """async () => {
          const { RGBAvatar } = await import("./rgbavatar.js"), set = RGBAvatar.prototype.setARKit;
          RGBAvatar.prototype.setARKit = function (...given) {
            set.apply(this, given);
            window.shown = this.theta;
          };
        }"""
    )
    page.get_by_role("button").click()
    page.wait_for_function("() => window.shown")
    wanted = neutral + avatar.theta_from_arkit({"jawOpen": 0.75})
    wanted[avatar.layout.slice("rotation")] = torch.tensor([0.0, 0.2, 0.0])
    assert page.evaluate("() => shown") == pytest.approx(wanted.tolist(), abs=1e-5)
    page.close()


_ELSEWHERE = (
    r"https://cdn\.jsdelivr\.net/npm/(@mediapipe/tasks-vision|three)@\d+\.\d+\.\d+(/.*)?"
    r"|https://storage\.googleapis\.com/mediapipe-models/face_landmarker/face_landmarker"
)


def test_only_two_examples_name_other_places_and_their_versions(folder):
    for file in [f for f in folder.iterdir() if f.suffix != ".rgba"]:
        named = re.findall(r"https?://[^\s\"'`]+", file.read_text())
        if file.name in {"example-mediapipe.html", "example-three.html"}:
            assert named
            assert all(re.fullmatch(_ELSEWHERE, place) for place in named)
        else:
            assert named == []


def test_a_second_export_leaves_examples_that_were_changed(avatar, theta, tmp_path):
    camera = front_camera(avatar, 8, 8)
    write_web_module(avatar, tmp_path, camera, theta)
    for name in ("example.html", "rgbavatar.js", "mine.txt"):
        (tmp_path / name).write_text("mine")
    write_web_module(avatar, tmp_path, camera, theta)
    assert (tmp_path / "example.html").read_text() == "mine"
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert (tmp_path / "rgbavatar.js").read_text().endswith("export { RGBAvatar };\n")
