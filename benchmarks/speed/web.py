"""What an avatar's page costs: kilobytes by part, work and milliseconds a picture by WebGL2 and
WebGPU, PSNR by detail.

    python benchmarks/speed/web.py RUN

RUN is a run of ns-train, a checkpoint or a bundle. Pictures are drawn by Chromium without a GPU
(SwiftShader), where a GPU's work counts about as it does on a GPU of its own: many times slower,
in the same proportions. Each time is the shortest of several, since other programs only slow down.
Chromium is looked for on the path, or where RGBAVATAR_CHROMIUM says.
"""

import argparse
import base64
import io
import json
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from playwright.sync_api import Browser, sync_playwright

from rgbavatar_ns import Avatar
from rgbavatar_ns.export import front_camera, pictures, write_web_page
from rgbavatar_ns.export.avatar_file import read_avatar_file
from rgbavatar_ns.export.views import resized

_FLAGS = (
    "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist "
    "--no-first-run --disable-background-networking --enable-unsafe-webgpu "
    "--use-webgpu-adapter=swiftshader --enable-features=Vulkan --use-vulkan=swiftshader"
)
_SIZES = ((1280, 800), (390, 844))
"""A laptop's window and a phone's screen."""
_SHARES = (
    {"bytes": False, "detail": 1.0, "resolution": 1.0},
    {"bytes": True, "detail": 1.0, "resolution": 1.0},
    {"bytes": True, "detail": 1.0, "resolution": 0.7},
    {"bytes": True, "detail": 0.5, "resolution": 0.5},
)
_DETAILS = (0.5, 0.25, 0.125)
_START = """
window.bench = (async () => {
  const data = await AvatarData.open(streamOfPage());
  await data.complete;
  const canvas = document.createElement("canvas");
  const { manifest } = data, size = manifest.layout.reduce((sum, field) => sum + field.size, 0);
  const theta = new Array(size).fill(0);
  const head = new Head(data), network = new WeightNetwork(data);
  const renderer = new Renderer(canvas, data), gl = renderer.gl;
  const gpuCanvas = document.createElement("canvas");
  const gpuRenderer = await GPURenderer.create(gpuCanvas, data).catch(() => null);
  const orbit = new OrbitCamera(manifest.camera, manifest.film.turn_reach);
  head.pose(theta);
  const psi = network.evaluate(theta), background = [1, 1, 1];
  const cameraOf = (width, height) => {
    for (const one of [canvas, gpuCanvas]) [one.width, one.height] = [width, height];
    return orbit.at(width, height, head.centre());
  };
  const best = (count, work) => {
    let least = Infinity;
    for (let i = 0; i < count; i++) {
      const start = performance.now();
      work(i);
      least = Math.min(least, performance.now() - start);
    }
    return least;
  };
  const pixel = new Uint8Array(4);
  const finished = {
    webgl2() {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits for the picture
    },
    webgpu: () => gpuRenderer.device.queue.onSubmittedWorkDone(),
  };
  return {
    kinds: gpuRenderer ? ["webgl2", "webgpu"] : ["webgl2"],
    picture(kind, width, height, detail) {
      const [drawing, shown] = kind === "webgl2" ? [renderer, canvas] : [gpuRenderer, gpuCanvas];
      drawing.detail = detail;
      drawing.draw(head, psi, cameraOf(width, height), background);
      drawing.detail = 1;
      return shown.toDataURL("image/png");
    },
    async milliseconds(kind, width, height, share, count) {
      const camera = cameraOf(width, height), drawing = kind === "webgl2" ? renderer : gpuRenderer;
      let least = Infinity;
      for (let i = 0; i < count; i++) {
        const start = performance.now();
        drawing.draw(head, psi, camera, background, share);
        await finished[kind]();
        least = Math.min(least, performance.now() - start);
      }
      return least;
    },
    processor(width, height, count) {
      const camera = cameraOf(width, height);
      const other = psi.map((value) => value + 0.01);
      return {
        network: best(count, () => network.evaluate(theta)),
        head: best(count, () => head.pose(theta)),
        order: best(count, () => renderer.order.sort(head, psi, camera, data.available)),
        "order, new psi": best(count, (i) => (
          renderer.order.sort(head, i % 2 ? psi : other, camera, data.available))),
      };
    },
    uploaded() {
      const rows = Math.ceil(data.available / TEXTURE_WIDTH);
      return head.vertices.byteLength + 4 * TEXTURE_WIDTH * rows + renderer.weightValues.byteLength;
    },
    fragments(width, height) {
      this.picture("webgl2", width, height, 1);
      const read = (place) => {
        const values = new Float32Array(4 * TEXTURE_WIDTH * renderer.rows);
        gl.bindFramebuffer(gl.FRAMEBUFFER, renderer.placeTarget);
        gl.readBuffer(gl.COLOR_ATTACHMENT0 + place);
        gl.readPixels(0, 0, TEXTURE_WIDTH, renderer.rows, gl.RGBA, gl.FLOAT, values);
        return values;
      };
      const place = read(0), shape = read(1);
      let sum = 0;
      for (let i = 0; i < data.available; i++) {
        sum += 4 * Math.hypot(place[4 * i + 2], place[4 * i + 3]) * shape[4 * i];
      }
      return sum;
    },
  };
})();
"""


def main() -> None:
    """Write the avatar's page, draw it and print what it costs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("run", type=Path)
    parser.add_argument("--pictures", type=int, default=10, help="of which the fastest counts")
    given = parser.parse_args()
    avatar = Avatar.load(given.run).without_undrawn()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        page = Path(folder) / "avatar.html"
        theta = torch.zeros(1, avatar.layout.size)
        write_web_page(avatar, page, front_camera(avatar, 512, 512), theta)
        _tell_parts(page.read_text(), Path(folder))
        chromium = os.environ.get("RGBAVATAR_CHROMIUM") or shutil.which("chromium")
        browser = driver.chromium.launch(executable_path=chromium, args=_FLAGS.split())
        _tell_pictures(browser, page, avatar, given.pictures)
        browser.close()


def _tell_parts(page: str, folder: Path) -> None:
    parts = re.findall(r'class="part">([^<]*)</script>', page)
    file = folder / "avatar.rgbavatar"
    file.write_bytes(b"".join(map(base64.b64decode, parts)))
    manifest, _ = read_avatar_file(file)
    print(f"page {len(page) / 1e3:.0f} kB, the avatar's file {file.stat().st_size / 1e3:.0f} kB")
    place = 0
    for number, (text, part) in enumerate(zip(parts, manifest["parts"])):
        place = page.index(text, place) + len(text)
        print(
            f"  part {number}: {part['bytes'] / 1e3:.0f} kB, {part['available']} Gaussians there, "
            f"at {place / 1e3:.0f} kB of the page"
        )


def _tell_pictures(browser: Browser, page: Path, avatar: Avatar, count: int) -> None:
    # The page's programs without the last one, which would draw and play by itself.
    *_, last = re.findall(r"<script>\n.*?</script>", page.read_text(), re.DOTALL)
    page.write_text(page.read_text().replace(last, f"<script>{_START}</script>"))
    tab = browser.new_page()
    tab.goto(page.as_uri())

    def asked(call: str) -> Any:
        return tab.evaluate(f"bench.then((bench) => bench.{call})")

    def picture(kind: str, width: int, height: int, detail: float) -> np.ndarray:
        url = asked(f"picture('{kind}', {width}, {height}, {detail})")
        png = base64.b64decode(url.split(",")[1])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) / 255.0

    times = ", ".join(f"{k} {v:.2f}" for k, v in asked(f"processor(1280, 800, {count})").items())
    print(f"processor, ms a picture: {times}; {asked('uploaded()') / 1e3:.0f} kB to the GPU")
    for width, height in _SIZES:
        each = asked(f"fragments({width}, {height})") / (width * height)
        print(f"{width} x {height}: {each:.1f} fragments a pixel; ms a picture")
        for share in _SHARES:
            told = ", ".join(f"{name} {value}" for name, value in share.items())
            given = f"{width}, {height}, {json.dumps(share)}, {count}"
            times = (
                f"{kind} {asked(f'milliseconds({kind!r}, {given})'):.0f}" for kind in asked("kinds")
            )
            print(f"  {told}: {', '.join(times)}")
    camera = resized(front_camera(avatar, 512, 512), *_SIZES[0])
    (ours,) = pictures(avatar, torch.zeros(1, avatar.layout.size), camera, (1.0, 1.0, 1.0))
    for kind in asked("kinds"):
        whole = picture(kind, *_SIZES[0], 1.0)
        print(f"{kind}, PSNR to Python's picture {_psnr(whole, ours / 255.0):.1f} dB; ", end="")
        print("to the whole by detail:")
        for detail in _DETAILS:
            print(f"  {detail}: {_psnr(picture(kind, *_SIZES[0], detail), whole):.1f} dB")


def _psnr(first: np.ndarray, second: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((first - second) ** 2)))


if __name__ == "__main__":
    main()
