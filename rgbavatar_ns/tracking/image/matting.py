"""A soft matte of the person: selfie segmentation, sharpened along the image's edges."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from rgbavatar_ns.tracking.face.detector import load_mediapipe

_Image = UInt8[np.ndarray, "H W 3"]
_Colors = Float[np.ndarray, "H W 3"]
_Alpha = Float[np.ndarray, "H W"]

_GUIDE_EPSILON = 1e-4 * 255**2
_FINE_SIDE_PX = 512
# The segmentation was made for lit rooms: darker pictures are brought to this level (of 1) first,
# judged by what all but one pixel in twenty stay below.
_LIT_LEVEL, _LIT_PERCENTILE, _DARK_BELOW = 0.75, 95, 150
# Square around the head that is segmented once more, as many times the face's height large and so
# much of it above the face's middle; it fades into the whole over a twelfth of its side, and is
# left out where it would be nearly the whole.
_CLOSE_UP, _RAISED, _FADE_SHARE, _NEARLY_ALL = 1.4, 0.12, 12, 0.9
_SEGMENTED_PX = 256
STRAY_ALPHA = 0.05
"""Of pieces of a matte: from which alpha on something is there."""
# Over what gaps they hang together, at half the size.
_BRIDGE_PX = 5


class PersonMatte:
    """mediapipe's selfie segmentation, refined by a guided filter.

    Each frame by itself: the result depends on one image alone.
    """

    def __init__(self) -> None:
        selfie = load_mediapipe().solutions.selfie_segmentation
        self._segmenter = selfie.SelfieSegmentation(model_selection=0)

    def close(self) -> None:
        """Free mediapipe's graph."""
        self._segmenter.close()

    def __call__(self, image_rgb: _Image) -> _Alpha:
        """Alpha in [0, 1], float32: 1 on the person, soft at hair."""
        return refined_matte(image_rgb, self.coarse(image_rgb))

    def coarse(self, image_rgb: _Image) -> _Alpha:
        """The segmentation alone, which knows no more than about 256 x 256 pixels."""
        found = self._segmenter.process(np.ascontiguousarray(image_rgb)).segmentation_mask
        return found.astype(np.float32)

    def coarse_with_face(
        self, image_rgb: _Image, face_px: Float[np.ndarray, "L 2"]
    ) -> Float[np.ndarray, "H W"]:
        """The segmentation of a brightened square image, its head segmented once more, closer.

        Twice the work of `coarse`, and a tenth to a third of its error less. `face_px` are the
        face's landmarks.
        """
        lit, size = _lit(image_rgb), len(image_rgb)
        whole = self.coarse(lit)
        low, high = face_px.min(0), face_px.max(0)
        height = float(high[1] - low[1])
        side = max(1, min(size, round(_CLOSE_UP * height)))
        if side > _NEARLY_ALL * size:
            return whole
        middle = (low + high) / 2 - (0, _RAISED * height)
        left, top = np.clip(middle - side / 2, 0, size - side).round().astype(int).tolist()
        here = (slice(top, top + side), slice(left, left + side))
        few = (_SEGMENTED_PX, _SEGMENTED_PX)
        close = self.coarse(cv2.resize(lit[here], few, interpolation=cv2.INTER_AREA))
        rows, columns = (_fade_in(start, side, size) for start in (top, left))
        share = np.minimum(rows[:, None], columns)
        found = whole.copy()
        found[here] += share * (cv2.resize(close, (side, side)) - whole[here])
        return found


def _lit(image_rgb: _Image) -> _Image:
    """A dark picture as a lit room would look; others as they are."""
    # A pixel in 64 tells it as well, in a fiftieth of the time.
    bright = float(np.percentile(image_rgb[::8, ::8], _LIT_PERCENTILE))
    if bright >= _DARK_BELOW:
        return image_rgb
    power = np.log(_LIT_LEVEL) / np.log(max(bright, 8) / 255)
    return cv2.LUT(image_rgb, (255 * (np.arange(256) / 255) ** power).astype(np.uint8))


def _fade_in(start: int, side: int, size: int) -> Float[np.ndarray, "side"]:
    """1 within a span, towards 0 at those of its ends that are not the image's own."""
    places = np.arange(side, dtype=np.float32)
    share = np.ones(side, np.float32)
    if start > 0:
        share = np.minimum(share, places * (_FADE_SHARE / side))
    if start + side < size:
        share = np.minimum(share, places[::-1] * (_FADE_SHARE / side))
    return share


def refined_matte(image_rgb: _Image, coarse: _Alpha) -> _Alpha:
    """The coarse matte drawn to the image's own edges by a guided filter (He 2010)."""
    longer = max(image_rgb.shape[:2])
    radius = max(2, round(longer / 45))
    # The filter's coefficients at half the size, where that is still finer than the segmentation: a
    # third of the time, and no difference that the eye finds (He and Sun 2015).
    scale = 0.5 if longer >= _FINE_SIDE_PX else 1.0
    fine = cv2.ximgproc.guidedFilter(image_rgb, coarse, radius, _GUIDE_EPSILON, None, -1, scale)
    # The segmentation hovers a little off 0 and 1; an avatar would learn that as haze.
    return np.clip((fine - 0.06) / 0.88, 0, 1).astype(np.float32)


def in_one_piece(alpha: _Alpha, person: Bool[np.ndarray, "h w"]) -> _Alpha:
    """Only what hangs together with most of a person, strands across small gaps too.

    Where the person is for certain, a picture of any size of it tells.
    """
    size = len(alpha)
    few = max(1, size // 2)
    seen = cv2.resize(alpha, (few, few), interpolation=cv2.INTER_AREA) > STRAY_ALPHA
    bridged = cv2.dilate(seen.astype(np.uint8), np.ones((_BRIDGE_PX, _BRIDGE_PX), np.uint8))
    _, labels = cv2.connectedComponents(bridged)
    there = cv2.resize(person.astype(np.uint8), (few, few), interpolation=cv2.INTER_NEAREST)
    votes = np.bincount(labels[(there > 0) & (bridged > 0)], minlength=1)
    if not votes.any():
        return alpha
    kept = (labels == votes.argmax()).astype(np.uint8)
    return alpha * cv2.resize(kept, (size, size), interpolation=cv2.INTER_NEAREST)


def straight_rgba(color: _Image, alpha: _Alpha) -> UInt8[np.ndarray, "H W 4"]:
    """Colour and alpha as an image; colour under zero alpha is black, which compresses well."""
    levels = cv2.convertScaleAbs(np.ascontiguousarray(alpha), alpha=255)
    seen = cv2.bitwise_and(color, color, mask=levels)
    return cv2.merge([*cv2.split(seen), levels])


def foreground_color(image_rgb: _Image, alpha: _Alpha, background: _Colors | None = None) -> _Image:
    """Straight-alpha colour: what the person's own colour is where the background shines through.

    Blurred-fusion estimate (Forte 2021, "Approximate fast foreground colour estimation") from
    coarse to fine: at a quarter of the size, at half of it, and the last correction at full size
    where both shine through; without it hair edges keep a fringe of the background's colour. There
    `background` counts, where it is known better than from the surroundings. Under zero alpha the
    image stays as it is.
    """
    height, width = alpha.shape
    longer = max(height, width)
    weight = alpha.astype(np.float32, copy=False)
    near = far = image_rgb
    for coarser, diameter in ((4, longer // 6), (2, longer // 40)):
        few = (max(1, width // coarser), max(1, height // coarser))
        small = cv2.resize(image_rgb, few, interpolation=cv2.INTER_AREA).astype(np.float32)
        before, behind = (
            small if part is image_rgb else cv2.resize(part, few, interpolation=cv2.INTER_AREA)
            for part in (near, far)
        )
        small_weight = cv2.resize(weight, few, interpolation=cv2.INTER_AREA)
        near, far = _fuse(small, before, behind, small_weight, diameter // coarser | 1)
    far = far if background is None else background
    mixed = np.flatnonzero((weight > 0) & (weight < 1))
    found = image_rgb.copy()
    if mixed.size:
        # As an image of one row, which is what OpenCV's arithmetic takes.
        image, near, far = (
            part.reshape(-1, 3)[mixed][None].astype(np.float32, copy=False)
            for part in (image_rgb, *(cv2.resize(part, (width, height)) for part in (near, far)))
        )
        color = _explained(image, near, far, weight.reshape(-1)[mixed][None])
        found.reshape(-1, 3)[mixed] = (color[0] + 0.5).astype(np.uint8)
    return found


def _fuse(
    image: _Colors, foreground: _Colors, background: _Colors, alpha: _Alpha, diameter: int
) -> tuple[_Colors, _Colors]:
    beyond = 1 - alpha
    # Cubed weights trust the solid parts: the mixed ones are what is to be explained.
    solid = alpha * alpha * alpha + 1e-4 * alpha
    empty = beyond * beyond * beyond + 1e-4 * beyond
    near = _weighted_blur(foreground, solid, diameter)
    far = _weighted_blur(background, empty, diameter)
    return _explained(image, near, far, alpha), far


def _explained(image: _Colors, foreground: _Colors, background: _Colors, alpha: _Alpha) -> _Colors:
    """The foreground, changed as far as alpha goes so that both together give the image."""
    mixed = cv2.merge([alpha, alpha, alpha])
    changed = cv2.multiply(mixed, cv2.subtract(foreground, background))
    cv2.add(changed, background, dst=changed)
    cv2.subtract(image, changed, dst=changed)
    cv2.multiply(mixed, changed, dst=changed)
    cv2.add(foreground, changed, dst=changed)
    return np.clip(changed, 0, 255, out=changed)


def _weighted_blur(values: _Colors, weight: _Alpha, diameter: int) -> _Colors:
    box = (diameter, diameter)
    total = cv2.blur(weight, box) + 1e-7
    return cv2.blur(values * weight[..., None], box) / total[..., None]
