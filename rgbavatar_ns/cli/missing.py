"""What an installation lacks, what for, and the line that brings it."""

import importlib
import importlib.metadata
import platform
import shutil
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rgbavatar_ns.tracking.face.detector import INSTALL_MEDIAPIPE

OPENCV = "opencv-contrib-python-headless"
OPENCV_BUILDS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", OPENCV)
"""All write the same folder `cv2`; the last one has what the others have and no windows."""
_OPENCV_VERSION = "4.10.0.84"

Installed = Callable[[str], str | None]
"""A package's installed version, or None."""
Found = Callable[[str], str | None]
"""A program's path, or None."""


@dataclass(frozen=True)
class Missing:
    """Something that would be used and is not there, or not as it should be."""

    task: str
    cause: str
    remedy: str


def installed(package: str) -> str | None:
    """The version of a package that pip knows."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def all_missing(
    version_of: Installed = installed, program: Found = shutil.which
) -> Iterator[Missing]:
    """What is missing here: first what stops all work, last what single options ask for."""
    yield from opencv(version_of)
    yield from torchvision()
    yield from gpu_build(version_of, program)
    yield from tracker(version_of)
    if program("ffmpeg") is None:
        yield Missing("ns-render", "no ffmpeg on the PATH", f"install ffmpeg ({_ffmpeg()})")
    absent = [name for name in ("open3d", "pymeshlab") if version_of(name) is None]
    if absent:
        yield Missing("ns-export", f"no {' and '.join(absent)}", f"pip install {' '.join(absent)}")
    for task, package, line in _OPTIONS:
        if version_of(package) is None:
            yield Missing(task, f"no {package}", line)


_OPTIONS = (
    ("export to spz, compressed-ply, sog", "gaussforge", 'pip install "gaussforge>=0.6,<1"'),
    ("drive --source vmc", "python-osc", "pip install python-osc"),
    ("drive to a virtual camera", "pyvirtualcam", "pip install pyvirtualcam"),
    ("sweep --engine ray", "ray", "pip install 'ray>=2.9'"),
)


def _ffmpeg() -> str:
    return {"Darwin": "brew install ffmpeg", "Windows": "winget install ffmpeg"}.get(
        platform.system(), "apt install ffmpeg"
    )


def opencv(version_of: Installed) -> Iterator[Missing]:
    """More than one OpenCV, which overwrite one another, or one without what the mattes need."""
    there = [name for name in OPENCV_BUILDS if version_of(name) is not None]
    if there == [OPENCV]:
        return
    cause = f"{' and '.join(there)} overwrite one another's cv2" if there else f"no {OPENCV}"
    if there and OPENCV not in there:
        cause = f"{' and '.join(there)} in place of {OPENCV}"
    away = f"pip uninstall -y {' '.join(there)} && " if there else ""
    line = f"{away}pip install --no-deps {OPENCV}=={_OPENCV_VERSION}"
    yield Missing("everything", cause, line)


def torchvision() -> Iterator[Missing]:
    """A torchvision that does not import, as one of another build than torch does."""
    import torch

    try:
        with warnings.catch_warnings():  # of its decoder of pictures, which is not used
            warnings.simplefilter("ignore")
            importlib.import_module("torchvision")
    except (ImportError, RuntimeError) as error:
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        yield Missing(
            "nerfstudio's commands",
            f"torchvision does not work beside torch {torch.__version__} ({first_line})",
            "install both from one index, as docs/install.md does",
        )


def gpu_build(version_of: Installed, program: Found) -> Iterator[Missing]:
    """A driver for NVIDIA GPUs beside a torch that cannot use it, or without CUDA's bindings."""
    import torch

    from rgbavatar_ns.kernels.registry import install_cuda_bindings

    if program("nvidia-smi") is None:
        return
    if torch.version.cuda is None:
        yield Missing(
            "training on the GPU",
            f"torch {torch.__version__} is a build for CPUs",
            "install torch and torchvision by docs/install.md's line for GPUs",
        )
    elif version_of("cuda-bindings") is None:
        line = install_cuda_bindings(torch.version.cuda)
        yield Missing("training on the GPU", "no cuda-bindings", line)
    elif not torch.cuda.is_available():
        yield Missing(
            "training on the GPU",
            f"torch {torch.__version__} for CUDA {torch.version.cuda} sees no GPU",
            "update the driver, where `nvidia-smi` shows an older CUDA, or install torch's build "
            "for that one; an empty CUDA_VISIBLE_DEVICES hides GPUs",
        )


def tracker(version_of: Installed) -> Iterator[Missing]:
    """No mediapipe, or a protobuf that its graphs fail beside."""
    mediapipe, protobuf = version_of("mediapipe"), version_of("protobuf")
    if mediapipe is None:
        yield Missing("track, drive from a camera or film", "no mediapipe", INSTALL_MEDIAPIPE)
    elif protobuf is None or int(protobuf.split(".")[0]) < 4:
        cause = f"mediapipe's graphs fail beside protobuf {protobuf}"
        yield Missing("track, drive from a camera or film", cause, INSTALL_MEDIAPIPE)
