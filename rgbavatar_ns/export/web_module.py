"""The avatar for web pages of one's own: its file, an ES module that shows it, and examples."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.export.avatar_file import avatar_parts
from rgbavatar_ns.export.web_manifest import avatar_manifest, driving_arrays
from rgbavatar_ns.export.web_scripts import module_source, web_text
from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.kernels import PinholeCameras

AVATAR_FILE, MODULE_FILE, TYPES_FILE = "avatar.rgba", "rgbavatar.js", "rgbavatar.d.ts"
EXAMPLES = ("example.html", "example-mediapipe.html", "example-three.html")
_WHITE = (1.0, 1.0, 1.0)


def write_web_module(
    avatar: Avatar,
    folder: Path,
    camera: PinholeCameras,
    theta: Float[Tensor, "F H"],
    frames_per_second: float = 25.0,
    seen: TrainingStatistics | None = None,
    neutral: Float[Tensor, "H"] | None = None,
) -> int:
    """Write the module's folder and return the size of the avatar's file in bytes.

    Of what is given see `write_web_page`. Examples that are there already stay as they are, since
    they are there to be changed; the avatar, the module and its types are replaced. Raises
    UserError where a file cannot be written.
    """
    manifest = avatar_manifest(avatar, camera, theta, seen, frames_per_second, _WHITE)
    content = b"".join(avatar_parts(avatar, manifest, theta, driving_arrays(avatar, neutral)))
    files = {
        AVATAR_FILE: content,
        MODULE_FILE: module_source().encode(),
        TYPES_FILE: web_text(TYPES_FILE).encode(),
    }
    files |= {name: web_text(name).encode() for name in EXAMPLES if not (folder / name).exists()}
    for name, written in files.items():
        with atomic_write(folder / name) as partial:
            partial.write_bytes(written)
    return len(content)
