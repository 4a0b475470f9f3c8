"""A soft matte of the person: selfie segmentation, sharpened along the picture's edges."""

from types import TracebackType

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.tracking.landmarks import load_mediapipe

_GUIDE_EPSILON = 1e-4 * 255**2


class PersonMatte:
    """mediapipe's selfie segmentation, refined by a guided filter; each frame by itself."""

    def __init__(self) -> None:
        selfie = load_mediapipe().solutions.selfie_segmentation
        self._segmenter = selfie.SelfieSegmentation(model_selection=0)

    def __enter__(self) -> "PersonMatte":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._segmenter.close()

    def __call__(self, image_rgb: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
        """Alpha in [0, 1], float32: 1 on the person, soft at hair."""
        coarse = self._segmenter.process(np.ascontiguousarray(image_rgb)).segmentation_mask
        radius = max(2, round(max(image_rgb.shape[:2]) / 45))
        fine = cv2.ximgproc.guidedFilter(
            image_rgb, coarse.astype(np.float32), radius, _GUIDE_EPSILON
        )
        # The segmentation hovers a little off 0 and 1; an avatar would learn that as haze.
        return np.clip((fine - 0.06) / 0.88, 0, 1).astype(np.float32)


def foreground_color(
    image_rgb: UInt8[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W 3"]:
    """Straight-alpha colour: what the person's own colour is where the background shines through.

    Blurred-fusion estimate (Forte 2021, "Approximate fast foreground colour estimation"), two
    passes from coarse to fine; without it hair edges keep a fringe of the background's colour.
    """
    image = image_rgb.astype(np.float32)
    weight = np.repeat(alpha[..., None].astype(np.float32), 3, axis=2)
    foreground, background = image, image
    for radius in (max(image.shape[:2]) // 6 | 1, max(image.shape[:2]) // 40 | 1):
        foreground, background = _fuse(image, foreground, background, weight, radius)
    return np.clip(foreground + 0.5, 0, 255).astype(np.uint8)


def _fuse(
    image: Float[np.ndarray, "H W 3"],
    foreground: Float[np.ndarray, "H W 3"],
    background: Float[np.ndarray, "H W 3"],
    alpha: Float[np.ndarray, "H W 3"],
    radius: int,
) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W 3"]]:
    def blur(values: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
        return cv2.blur(values, (radius, radius))

    # Cubed weights trust the solid parts: the mixed ones are what is to be explained.
    solid, empty = alpha**3 + 1e-4 * alpha, (1 - alpha) ** 3 + 1e-4 * (1 - alpha)
    near = blur(foreground * solid) / (blur(solid) + 1e-7)
    far = blur(background * empty) / (blur(empty) + 1e-7)
    near = near + alpha * (image - alpha * near - (1 - alpha) * far)
    return np.clip(near, 0, 255), np.clip(far, 0, 255)
