"""The coarse matte is drawn to the picture's edges, at half the size where pictures are large."""

import cv2
import numpy as np
import pytest

from rgbavatar_ns.tracking.image.matting import refined_matte


@pytest.mark.parametrize("side", [256, 640])
def test_the_edge_is_the_picture_s(side):
    """A bright disc whose segmentation is a little too large and soft."""
    rows, columns = np.mgrid[:side, :side]
    distance = np.hypot(rows - side / 2, columns - side / 2) / side
    image = np.where((distance < 0.3)[..., None], [200, 160, 140], [40, 60, 50]).astype(np.uint8)
    coarse = np.clip((0.33 - distance) * 20, 0, 1).astype(np.float32)
    coarse = cv2.GaussianBlur(coarse, (0, 0), side / 64)
    found = refined_matte(image, coarse)
    truth = (distance < 0.3).astype(np.float32)
    assert found.dtype == np.float32
    assert 0 <= found.min() <= found.max() <= 1
    assert np.abs(found - truth).mean() < 0.75 * np.abs(coarse - truth).mean()
    # Away from the edge by more than the filter's reach it is certain.
    assert found[distance < 0.25].min() > 0.99
    assert found[distance > 0.4].max() < 0.01
