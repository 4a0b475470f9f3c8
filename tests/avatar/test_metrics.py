import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import structural_similarity_index_measure

from rgbavatar_ns.avatar import metrics
from rgbavatar_ns.avatar.metrics import LPIPSMetric, evaluate_images, mean_scores, psnr, ssim
from rgbavatar_ns.avatar.model.image_loss import LPIPSLoss
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA


@pytest.fixture
def pair():
    rng = np.random.default_rng(0)
    image = np.zeros((2, 40, 48, 3))
    image[:, 12:28, 12:36] = rng.random((2, 16, 24, 3))
    target = image.copy()
    target[:, 12:28, 12:36] += rng.normal(0, 0.1, (2, 16, 24, 3))
    return image, target.clip(0, 1)


def test_psnr_by_hand():
    # An error of .1 everywhere is 20 dB, of .01 is 40 dB.
    image = torch.zeros(2, 4, 4, 3, dtype=torch.float64)
    target = torch.full_like(image, 0.1)
    target[1] = 0.01
    torch.testing.assert_close(psnr(image, target), torch.tensor([20.0, 40.0]).double())


def test_equal_pictures_have_100_db_and_leave_means_finite():
    image = torch.zeros(3, 4, 4, 3, dtype=torch.float64)
    target = torch.zeros_like(image)
    target[0] = 0.01
    inside = torch.ones(3, 4, 4, dtype=torch.bool)
    inside[2] = False
    assert psnr(image, target)[1:].tolist() == [100.0, 100.0]
    found = psnr(image, target, inside)
    assert found[:2].tolist() == pytest.approx([40.0, 100.0])
    assert math.isnan(found[2])
    frames = [{"psnr": score} for score in found.tolist()]
    assert mean_scores(frames)["psnr"] == pytest.approx(70.0)


def test_psnr_and_ssim_equal_scikit_images(pair):
    image, target = pair
    values = psnr(torch.from_numpy(image), torch.from_numpy(target))
    expected = [peak_signal_noise_ratio(t, i, data_range=1) for i, t in zip(image, target)]
    np.testing.assert_allclose(values.numpy(), expected, rtol=1e-6)
    similarity = ssim(torch.from_numpy(image), torch.from_numpy(target))
    # The full frame's mean; black margins make libraries agree, whose borders are padded unlike.
    options = {"data_range": 1, "channel_axis": -1, "gaussian_weights": True, "sigma": 1.5}
    options |= {"use_sample_covariance": False, "full": True}
    pairs = zip(target, image)
    expected = [structural_similarity(*pair, **options)[1].mean() for pair in pairs]
    np.testing.assert_allclose(similarity.numpy(), expected, rtol=1e-4)


def test_ssim_is_torchmetrics_up_to_the_border():
    """Also where a picture goes on to its border, in flat parts, and of equal pictures."""
    draw = torch.Generator().manual_seed(0)
    image = torch.rand(3, 24, 33, 3, generator=draw)
    target = (image + 0.2 * torch.rand(3, 24, 33, 3, generator=draw)).clamp(0, 1)
    image[1, :12], target[1, :12] = 0.5, 0.5
    target[2] = image[2]
    planes = (one.movedim(-1, 1) for one in (image, target))
    wanted = structural_similarity_index_measure(*planes, data_range=1.0, reduction="none")
    torch.testing.assert_close(ssim(image, target), wanted, atol=1e-5, rtol=0)


def test_targets_are_laid_over_black_and_images_clamped():
    target = torch.tensor([255, 255, 255, 51], dtype=torch.uint8).expand(1, 16, 16, 4)
    image = torch.full((1, 16, 16, 3), 0.3)
    assert evaluate_images(image, target)["psnr"] == pytest.approx(20.0, abs=1e-3)
    white = torch.full((1, 16, 16, 4), 255, dtype=torch.uint8)
    assert evaluate_images(torch.full((1, 16, 16, 3), 7.0), white)["psnr"] == 100
    names = {"psnr", "psnr_head", "ssim", "detail", "detail_film"}
    assert evaluate_images(image, target).keys() == names


def test_psnr_of_the_head_counts_its_pixels_alone():
    """An error of .1 on a quarter of the frame, the person: 20 dB, of the whole frame 6 dB more."""
    image = torch.zeros(1, 20, 20, 3)
    target = torch.zeros(1, 20, 20, 4)
    target[:, :10, :10] = torch.tensor([0.1, 0.1, 0.1, 1.0])
    target[:, 10:, :10] = torch.tensor([0.9, 0.9, 0.9, 0.0])
    values = evaluate_images(image, target)
    assert values["psnr_head"] == pytest.approx(20.0, abs=1e-4)
    assert values["psnr"] == pytest.approx(20.0 + 10 * math.log10(4), abs=1e-4)


def test_lpips_offline_is_reported_and_the_others_go_on(monkeypatch):
    tries = []

    def offline(self):
        tries.append(self.net)
        raise UserError("LPIPS (vgg) is unavailable: offline.", "Go online.")

    monkeypatch.setattr(LPIPSLoss, "network", offline)
    lpips = LPIPSMetric()
    target = torch.randint(0, 255, (1, 16, 16, 4), dtype=torch.uint8)
    for _ in range(2):
        values = evaluate_images(torch.rand(1, 16, 16, 3), target, lpips)
        assert values["lpips_vgg"] is None
        assert "offline" in str(values["lpips_unavailable"])
        assert isinstance(values["psnr"], float)
    assert tries == ["vgg"]


def test_the_network_is_named_beside_the_number(monkeypatch):
    monkeypatch.setattr(
        metrics.LPIPSLoss, "__call__", lambda self, image, target: torch.tensor(0.125)
    )
    target = torch.randint(0, 255, (1, 16, 16, 4), dtype=torch.uint8)
    values = evaluate_images(torch.rand(1, 16, 16, 3), target, LPIPSMetric("alex"))
    assert values["lpips_alex"] == 0.125
    assert "lpips_unavailable" not in values


def test_importing_the_avatar_loads_neither_torchmetrics_nor_torchvision():
    code = (
        "import sys, rgbavatar_ns.avatar.metrics, rgbavatar_ns.avatar.training.loop;"
        "print([m for m in ('torchmetrics', 'torchvision', 'nerfstudio') if m in sys.modules])"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "[]"


def test_what_nobody_filmed_does_not_count():
    """Whatever is drawn there; and PSNR is that of the filmed part as a picture of its own."""
    generator = torch.Generator().manual_seed(0)
    target = torch.randint(0, 256, (2, 40, 48, 4), generator=generator, dtype=torch.uint8)
    target[..., 3] = 255
    image = torch.rand(2, 40, 48, 3, generator=generator)
    filmed = evaluate_images(image[:, :24], target[:, :24])
    whole = evaluate_images(image, target)
    target[:, 24:] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    values = evaluate_images(image, target)
    assert values["psnr"] == pytest.approx(filmed["psnr"], abs=1e-4)
    assert values["psnr_head"] == pytest.approx(filmed["psnr_head"], abs=1e-4)
    assert values["ssim"] > whole["ssim"]
    other = image.clone()
    other[:, 24:] = 0.5
    assert evaluate_images(other, target)["psnr"] == pytest.approx(values["psnr"], abs=1e-4)
    target[:] = target[0, 24, 0]
    assert evaluate_images(image, target)["ssim"] == pytest.approx(1)
