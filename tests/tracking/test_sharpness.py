"""How wide a film's edges are is measured, and found mattes are softened by just that."""

import cv2
import numpy as np
import pytest

from rgbavatar_ns.tracking.image import frame_images
from rgbavatar_ns.tracking.image.background import Background
from rgbavatar_ns.tracking.image.sharpness import edge_width_px

SIZE = 200


def _filmed(blur_px: float, noise_levels: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """A drawn person's outline with edges within, seen through a lens, and its matte."""
    large = np.zeros((4 * SIZE, 4 * SIZE), np.float32)
    cv2.circle(large, (400, 420), 270, (1.0,), -1)
    matte = cv2.resize(large, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    for column in range(200, 600, 80):
        cv2.rectangle(large, (column, 300), (column + 37, 480), (0.35,), -1)
    grey = 60 + 120 * cv2.resize(large, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    if blur_px:
        grey = cv2.GaussianBlur(grey, (0, 0), blur_px)
    noise = np.random.default_rng(0).normal(0, noise_levels, (SIZE, SIZE, 3))
    return np.clip(grey[..., None] + noise, 0, 255).round().astype(np.uint8), matte


@pytest.mark.parametrize("blur_px", [1.0, 1.4, 1.8])
def test_the_lens_s_blur_is_found(blur_px: float) -> None:
    sharp, blurred = edge_width_px(*_filmed(0)), edge_width_px(*_filmed(blur_px))
    assert sharp is not None
    assert blurred is not None
    # Widths of a pixel and of a lens add as variances do.
    assert sharp < 0.7
    assert blurred == pytest.approx(np.hypot(sharp, blur_px), rel=0.15)


def test_noise_and_what_is_far_from_the_person_do_not_pass_for_edges() -> None:
    quiet, noisy = (edge_width_px(*_filmed(1.4, noise)) for noise in (0.0, 4.0))
    assert noisy == pytest.approx(quiet, rel=0.15)
    image, matte = _filmed(1.4)
    image[:, :20] = 0
    image[5:195:4, :20] = 255
    assert edge_width_px(image, matte) == pytest.approx(edge_width_px(*_filmed(1.4)), rel=0.01)


def test_a_picture_without_edges_tells_nothing() -> None:
    _, matte = _filmed(0)
    assert edge_width_px(np.full((SIZE, SIZE, 3), 90, np.uint8), matte) is None


def test_mattes_of_a_sharp_film_stay_sharp_and_no_softening_is_wide() -> None:
    soft = [
        frame_images._softness_px(Background("still", None, 0.0, None, edge_px))
        for edge_px in (0.5, 0.75, 0.95, 5.0)
    ]
    assert soft[0] == 0
    # 1.25 sqrt(.75^2 - .65^2) and 1.25 sqrt(.95^2 - .65^2)
    np.testing.assert_allclose(soft[1:3], [0.468, 0.866], atol=1e-3)
    assert soft[3] == 1
    unknown = frame_images._softness_px(Background("still", None, 0.0, None))
    assert soft[2] < unknown <= 1
