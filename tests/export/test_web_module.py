"""The ES module in a real browser: Python's pictures, whoever drives, whoever's camera."""

import pytest
import torch

from rgbavatar_ns.head.rotations import axis_angle_to_matrix
from tests.browser import IN_BROWSER

from .module_page import SIZE, canvas_of, drawn_by_us, foreign_camera, load_avatar
from .subject import psnr

pytestmark = IN_BROWSER


def test_at_first_the_calm_face_is_shown_as_render_draws_it(page, avatar, neutral):
    shown = canvas_of(page)
    assert psnr(shown[..., :3], drawn_by_us(avatar, neutral)[0]) > 45
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
        assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, numbers)[0]) > 45


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
    assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, wanted)[0]) > 45
    page.evaluate("() => avatar.setARKit({})")
    assert page.evaluate("() => avatar.theta") == pytest.approx(neutral.tolist(), abs=1e-6)


def test_a_canvas_without_a_style_keeps_its_place_at_any_pixel_density(page):
    page.evaluate(
        """async () => {
          window.devicePixelRatio = 1.5;
          const canvas = document.createElement("canvas");
          canvas.style.all = "initial"; // of the rule for the others
          [canvas.width, canvas.height] = [120, 80];
          document.body.append(canvas);
          window.bare = await module.RGBAvatar.load({ data: avatar.data }, canvas);
        }"""
    )
    sizes = """() => {
      const { width, height, clientWidth, clientHeight } = bare.canvas;
      return [width, height, clientWidth, clientHeight];
    }"""
    for _ in range(4):
        page.evaluate("() => bare.draw()")
        assert page.evaluate(sizes) == [180, 120, 120, 80]
    page.evaluate("() => { window.devicePixelRatio = 2; }")
    page.wait_for_function("() => bare.canvas.width === 240")
    assert page.evaluate(sizes) == [240, 160, 120, 80]


def test_what_is_disposed_of_is_kept_by_nobody_who_shares_its_data(page):
    page.evaluate(
        """async () => {
          const canvas = document.querySelectorAll("canvas")[1];
          window.second = await module.RGBAvatar.load({ data: avatar.data }, canvas);
        }"""
    )
    assert page.evaluate("() => avatar.data.arrivals.size") == 2
    page.evaluate("() => second.dispose()")
    assert page.evaluate("() => avatar.data.arrivals.size") == 1


def test_unknown_names_are_told_once(page):
    told: list[str] = []
    page.on("console", lambda message: told.append(message.text))
    page.evaluate("() => { for (let i = 0; i < 3; i++) avatar.setARKit({ smile: 1, tongue: 1 }); }")
    assert len(told) == 2
    assert 'ARKit has no blend shape "smile"' in told[0]


def test_another_programs_camera_sees_what_render_draws_from_there(page, avatar, theta):
    cameras, view, projection = foreign_camera(SIZE, SIZE)
    page.evaluate("numbers => avatar.setTheta(numbers)", theta[0].double().tolist())
    # For a picture of half the size, which is stretched.
    page.evaluate(
        "([view, projection]) => avatar.setCamera("
        "module.RGBAvatar.openGLCamera(view, projection, 48, 48))",
        [view, projection],
    )
    ours = drawn_by_us(avatar, theta[0], cameras)[0]
    assert ours.std() > 0.1
    assert psnr(canvas_of(page)[..., :3], ours) > 45
    page.evaluate("() => avatar.setCamera(null)")
    assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, theta[0])[0]) > 45


def test_the_pose_of_a_matrix_turns_as_the_matrix_does(page):
    half = torch.tensor([[0.0, 0.6, 0.8], [-1.0, 0.0, 0.0], [0.1, -2.0, 0.3]])
    half = torch.pi * half / half.norm(dim=1, keepdim=True)
    generator = torch.Generator().manual_seed(3)
    drawn = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    turns = torch.cat([drawn, 1e-9 * drawn[:2], half.double(), torch.zeros(1, 3)])
    matrices = 1.7 * axis_angle_to_matrix(turns)
    for matrix in matrices:
        whole = torch.eye(4, dtype=torch.float64)
        whole[:3, :3], whole[:3, 3] = matrix, torch.tensor([3.0, -4.0, -50.0])
        pose = page.evaluate(
            "numbers => module.RGBAvatar.poseOfMatrix(numbers)", whole.T.flatten().tolist()
        )
        found = axis_angle_to_matrix(torch.tensor(pose["rotation"], dtype=torch.float64))
        assert torch.allclose(1.7 * found, matrix, atol=1e-6)
        assert pose["translation"] == pytest.approx([0.03, -0.04, -0.5])


def test_a_transparent_picture_has_the_renderers_alpha(page, avatar, theta):
    page.evaluate("numbers => avatar.setTheta(numbers)", theta[0].double().tolist())
    page.evaluate("() => { avatar.background = null; }")
    shown = canvas_of(page)
    picture, alpha = drawn_by_us(avatar, theta[0])
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
    load_avatar(bare_page)
    bare_page.evaluate("() => { avatar.setSize(50, 60); avatar.draw(); avatar.setSize(); }")
    assert bare_page.evaluate("() => objects.size") > 10
    bare_page.evaluate("() => { window.gone = avatar; avatar.dispose(); avatar.dispose(); }")
    assert bare_page.evaluate("() => objects.size") == 0
    pictures = bare_page.evaluate(
        "() => { gone.setARKit({ jawOpen: 1 }); gone.draw(); return gone.pictures; }"
    )
    load_avatar(bare_page)
    assert psnr(canvas_of(bare_page)[..., :3], drawn_by_us(avatar, neutral)[0]) > 45
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
    assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, wanted)[0]) > 45


def test_two_canvases_share_the_data_and_draw_apart(page, avatar, neutral, theta):
    page.evaluate(
        """async (numbers) => {
          window.other = await module.RGBAvatar.load({ data: avatar.data },
            document.querySelectorAll("canvas")[1], { background: [1, 1, 1], automatic: false });
          avatar.setTheta(numbers);
        }""",
        theta[0].double().tolist(),
    )
    assert psnr(canvas_of(page, "other")[..., :3], drawn_by_us(avatar, neutral)[0]) > 45
    assert psnr(canvas_of(page)[..., :3], drawn_by_us(avatar, theta[0])[0]) > 45
