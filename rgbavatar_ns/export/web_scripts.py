"""The programs of the web page and of the module: which, in what order, put together how."""

from collections.abc import Iterable
from importlib import resources

AVATAR_SCRIPTS = (
    "data.js",
    "rotations.js",
    "theta.js",
    "head.js",
    "weights.js",
    "gaussians.js",
    "gaussian_renderer.js",
    "shaders.js",
    "renderer.js",
    "gpu_shaders.js",
    "gpu_renderer.js",
    "pace.js",
    "camera.js",
    "arkit.js",
    "performance.js",
    "avatar.js",
)
"""An avatar on a canvas, in the order in which they build on one another."""
PAGE_SCRIPTS = (*AVATAR_SCRIPTS, "panel.js", "live.js", "keyboard.js", "main.js")
"""The page around it."""


def web_text(name: str) -> str:
    """A file of the page."""
    return (resources.files("rgbavatar_ns.export") / "web" / name).read_text(encoding="utf-8")


def sources(scripts: Iterable[str]) -> list[str]:
    """The programs' texts; as plain scripts they see one another's names."""
    return [web_text(name) for name in scripts]


def module_source() -> str:
    """An avatar on a canvas as one ES module, which needs nothing else."""
    return "\n".join([*sources(AVATAR_SCRIPTS), "export { RGBAvatar };\n"])
