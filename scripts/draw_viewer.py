"""Draw the pictures of docs/look.md: nerfstudio's viewer of a run, in Chromium.

    python -m scripts.draw_viewer outputs/demo

opens `ns-viewer` on the run's newest config (`make demo` makes one), uses the panel as a user does,
and writes `docs/viewer_*.jpg`. Needs Chromium and the packages of the tests.
"""

import argparse
import io
import tempfile
from pathlib import Path

from PIL import Image

from rgbavatar_ns.files import atomic_write
from tests.plugin.viewer_page import ViewerPage, started, viewer_page

DOCS = Path(__file__).resolve().parents[1] / "docs"
WIDTH_PX, HEIGHT_PX, JPEG_QUALITY = 1000, 900, 85
SETTLED_MS = 4000
"""Until a picture stands still; nothing is asserted here, as in the tests of the viewer."""


def drive(viewer: ViewerPage) -> None:
    """A frame of the film."""
    viewer.tab("Drive")
    viewer.choose("Driven by", "dataset frame")
    viewer.set_number("Frame", "185")


def look(viewer: ViewerPage) -> None:
    """The film beside the avatar, and the error."""
    viewer.tab("Look")
    viewer.choose("Picture", "beside the film")


def face(viewer: ViewerPage) -> None:
    """An expression by hand, seen from the side."""
    viewer.choose("Picture", "avatar")
    viewer.drag(50, 15)
    viewer.tab("Face")
    viewer.set_number("Jaw opens (°)", "12")


def bases(viewer: ViewerPage) -> None:
    """One learned basis alone."""
    viewer.tab("Bases")
    viewer.choose("Show one alone", "2")


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    configs = sorted(parser.parse_args().run.rglob("config.yml"), key=lambda p: p.stat().st_mtime)
    if not configs:
        parser.error("no config.yml below this folder; `make demo` trains a run")
    command = ["ns-viewer", "--load-config", str(configs[-1])]
    with (
        tempfile.TemporaryDirectory() as folder,
        started(command, Path(folder) / "viewer.log") as address,
        viewer_page(address, WIDTH_PX, HEIGHT_PX) as viewer,
    ):
        viewer.page.get_by_role("tab", name="Drive", exact=True).wait_for(timeout=120_000)
        for use in (drive, look, face, bases):
            use(viewer)
            viewer.page.mouse.move(
                20, 450
            )  # away from the controls, whose hints would lie over them
            viewer.page.wait_for_timeout(SETTLED_MS)
            place = DOCS / f"viewer_{use.__name__}.jpg"
            with atomic_write(place) as partial:
                image = Image.open(io.BytesIO(viewer.page.screenshot())).convert("RGB")
                image.save(partial, "JPEG", quality=JPEG_QUALITY)
            print(f"{place.name}: {place.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
