"""A bundle where nothing but torch, numpy and the package can be imported."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from .subject import avatar_of, lively_theta

_PROGRAM = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"nerfstudio", "viser", "gsplat", "torchmetrics", "cv2", "av",
                                  "trimesh", "mediapipe", "open3d", "matplotlib", "tyro"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Refuse())
import numpy as np
import torch
from rgbavatar_ns import Avatar
from rgbavatar_ns.kernels import PinholeCameras

torch.set_num_threads(int(sys.argv[3]))
avatar = Avatar.load(sys.argv[1])
view = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None]
view[0, 2, 3] = 1.0
camera = PinholeCameras(view, torch.full((1, 2), 200.0), torch.full((1, 2), 32.0), 64, 64)
theta = torch.from_numpy(np.load(sys.argv[2] + "/theta.npy"))
with torch.no_grad():
    image = avatar.render(theta, camera, torch.ones(3)).image
np.save(sys.argv[2] + "/image.npy", image.numpy())
"""


@pytest.mark.slow
def test_a_bundle_renders_the_same_bits_without_nerfstudio(tmp_path):
    from rgbavatar_ns.kernels import PinholeCameras

    avatar = avatar_of()
    avatar.save(tmp_path / "bundle")
    theta = lively_theta(avatar, 1)
    np.save(tmp_path / "theta.npy", theta.numpy())
    threads = str(torch.get_num_threads())
    command = [sys.executable, "-c", _PROGRAM, str(tmp_path / "bundle"), str(tmp_path), threads]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    view = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None]
    view[0, 2, 3] = 1.0
    camera = PinholeCameras(view, torch.full((1, 2), 200.0), torch.full((1, 2), 32.0), 64, 64)
    with torch.no_grad():
        ours = avatar.render(theta, camera, torch.ones(3)).image.numpy()
    assert np.array_equal(np.load(tmp_path / "image.npy"), ours)
    assert ours.std() > 0.1
