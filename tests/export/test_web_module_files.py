"""What the module's folder holds: the avatar's file, types, examples; and files that are none."""

import re

import numpy as np
import pytest
import torch

from rgbavatar_ns.export import front_camera, write_web_module
from tests.browser import IN_BROWSER

from .module_page import canvas_of

pytestmark = IN_BROWSER


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
    assert canvas_of(bare_page)[..., :3].std() > 0.1


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


@pytest.mark.parametrize(
    ("before", "read", "said"),
    [
        ("", "controller.error(new TypeError('network error'))", "connection was lost after 3000"),
        ("delete window.DecompressionStream", "controller.close()", "no DecompressionStream"),
    ],
    ids=["network", "old browser"],
)
def test_what_is_no_fault_of_the_file_is_not_called_damage(bare_page, folder, before, read, said):
    told = bare_page.evaluate(
        f"""async () => {{
          const whole = new Uint8Array(await (await fetch("avatar.rgba")).arrayBuffer());
          {before};
          let begun = false;
          const source = new ReadableStream({{ pull(controller) {{
            if (begun) {read};
            else controller.enqueue(whole.slice(0, 3000));
            begun = true;
          }} }});
          return module.RGBAvatar.load(source, document.querySelector("canvas"))
            .then((avatar) => avatar.complete)
            .then(() => "", (error) => error.message);
        }}"""
    )
    assert said in told


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
