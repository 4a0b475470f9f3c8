"""A procedural person with loose hair, filmed in a room: a clip and its true mattes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson
from rgbavatar_ns.synthetic.performer.hair import HairStyle
from rgbavatar_ns.synthetic.performer.performance import perform
from rgbavatar_ns.synthetic.performer.regions import above_hairline_m

FRAMES_PER_SECOND = 20
HEIGHT_PX, WIDTH_PX = 480, 640
_STRANDS, _STRAND_M, _STRAND_POINTS = 4000, 0.024, 7
_STRAND_FINE = 3
"""Strands are drawn so many times larger, then averaged."""
_HAIR_SRGB = (66.0, 48.0, 38.0)
_SHIRT_SRGB = (58.0, 84.0, 112.0)
# What a dim room's exposure leaves of linear light, and the power that stands for sRGB's curve.
_DIM, _GAMMA = 0.22, 2.2

# How a hand moves a camera: turns about the axes to the right, down and ahead, ways along these,
# in shares of each other; and how much of such a way shows in the room, which is farther away.
_FOCAL_PX = 800.0
_HAND = (1.0, 1.0, 3.0, 1.0, 1.0, 3.0)
_ROOM_MOVES = 0.4

RGBA = Float[np.ndarray, "H W 4"]
_Homography = Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Room:
    """What is behind the person, and how the camera sees it."""

    background: Callable[[np.random.Generator], Float[np.ndarray, "H W 3"]]
    noise_levels: float
    dim: bool = False


def _smooth_field(rng: np.random.Generator, cells: int) -> Float[np.ndarray, "H W"]:
    coarse = rng.standard_normal((cells, cells)).astype(np.float32)
    return cv2.resize(coarse, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)


def light_wall(rng: np.random.Generator) -> Float[np.ndarray, "H W 3"]:
    """A painted wall under a lamp, with a door's edge."""
    wall = 206 + 14 * _smooth_field(rng, 3) + 1.5 * _smooth_field(rng, 90)
    edge = int(rng.uniform(0.05, 0.2) * WIDTH_PX)
    wall[:, :edge] -= 30
    return np.clip(wall[..., None] * np.array([1.0, 0.985, 0.95]), 0, 250)


def busy_shelf(rng: np.random.Generator) -> Float[np.ndarray, "H W 3"]:
    """Rows of books of all colours, a little out of focus."""
    room = np.zeros((HEIGHT_PX, WIDTH_PX, 3))
    for top in range(0, HEIGHT_PX, 120):
        left = 0
        while left < WIDTH_PX:
            width, gap = int(rng.integers(9, 34)), int(rng.integers(0, 40))
            book = rng.uniform(20, 225, 3) * rng.uniform(0.4, 1)
            room[top : top + 112, left : left + width] = 30
            room[top + gap : top + 112, left : left + width] = book
            stripe = top + gap + int(rng.integers(8, 40))
            room[stripe : stripe + 8, left + 2 : left + width - 2] = 255 - book
            left += width + 1
        room[top + 112 : top + 120] = (120, 84, 50)
    return cv2.GaussianBlur(room, (0, 0), 1.2)


def dark_room(rng: np.random.Generator) -> Float[np.ndarray, "H W 3"]:
    """A wall at night with dim furniture and a lamp's glow far to the side."""
    room = 27 + 7 * _smooth_field(rng, 4) + 1.0 * _smooth_field(rng, 60)
    for _ in range(7):
        left, top = int(rng.integers(0, WIDTH_PX)), int(rng.integers(0, HEIGHT_PX))
        wide, high = int(rng.integers(40, 160)), int(rng.integers(40, 220))
        room[top : top + high, left : left + wide] += rng.uniform(-14, 20)
    glow = np.hypot(*np.meshgrid(np.arange(WIDTH_PX) - 30, np.arange(HEIGHT_PX) - 60))
    room = room + 40 * np.exp(-((glow / 90) ** 2))
    tint = np.array([1.05, 0.95, 0.85])
    return cv2.GaussianBlur(np.clip(room[..., None] * tint, 4, 255), (0, 0), 1.5)


ROOMS = {
    "light": Room(light_wall, 2.0),
    "busy": Room(busy_shelf, 2.5),
    "dark": Room(dark_room, 3.0, dim=True),
}


class Performance:
    """One person's true frames, with loose hair and shoulders: straight alpha, lit evenly."""

    def __init__(
        self, seed: int, frames: int, supersampling: int = 3, hair: HairStyle = "short"
    ) -> None:
        config = DemoConfig(
            image_size=HEIGHT_PX,
            num_frames=frames,
            num_test_frames=frames // 4,
            seed=seed,
            frames_per_second=FRAMES_PER_SECOND,
            glasses=False,
            supersampling=supersampling,
            hair=hair,
        )
        person = DemoPerson.of(config)
        names = person.head.arrays.expression_names
        acted = perform(person.head.layout, names, frames, frames // 4, FRAMES_PER_SECOND, seed)
        theta = torch.from_numpy(acted).float()
        strands = _Strands(person, seed)
        torso = _shoulders(np.random.default_rng([seed, 12]))
        turns = [(one.head_rotation, one.head_shift_m) for one in person.moments(theta)]
        self.frames: list[UInt8[np.ndarray, "H W 4"]] = []
        for image, (turn, shift) in zip(person.draw(theta), turns):
            head = np.zeros((HEIGHT_PX, WIDTH_PX, 4), np.float32)
            left = (WIDTH_PX - HEIGHT_PX) // 2
            head[:, left : left + HEIGHT_PX] = image / np.float32(255)
            loose = strands.drawn(turn, shift)
            self.frames.append(np.round(255 * _over(head, _over(loose, torso))).astype(np.uint8))


def _over(front: RGBA, behind: RGBA) -> RGBA:
    """Straight-alpha pictures, one before the other."""
    a, b = front[..., 3:], behind[..., 3:] * (1 - front[..., 3:])
    alpha = a + b
    color = (front[..., :3] * a + behind[..., :3] * b) / np.maximum(alpha, 1e-6)
    return np.concatenate([color, alpha], -1)


class _Strands:
    """Thin curls that stand off the skull and turn with it."""

    def __init__(self, person: DemoPerson, seed: int) -> None:
        rng = np.random.default_rng([seed, 11])
        arrays = person.head.arrays
        hairy = np.flatnonzero(above_hairline_m(arrays.v_template) > 0.004)
        rest = torch.zeros(1, person.head.layout.size)
        at_rest = person.head(rest, person.identity)[0].numpy()
        roots = at_rest[rng.choice(hairy, _STRANDS)]
        outward = roots - at_rest[hairy].mean(0) + np.array([0, 0.02, 0])
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        bend = rng.standard_normal((_STRANDS, 3))
        along = np.linspace(0, 1, _STRAND_POINTS)[:, None, None]
        # Mostly a soft fringe, and a few that stand far off.
        length = _STRAND_M * rng.uniform(0.1, 1.0, (_STRANDS, 1)) ** 3
        falls = np.array([0, -0.3, 0])
        self._points = roots + length * (
            along * outward + along**2 * (0.5 * bend + falls) + 0.12 * along**3 * bend[::-1]
        )
        self._opacity = rng.uniform(0.35, 0.95, _STRANDS)
        self._camera = person.camera

    def drawn(self, turn: Float[np.ndarray, "3 3"], shift_m: Float[np.ndarray, "3"]) -> RGBA:
        """Straight alpha, over the whole frame."""
        camera, fine = self._camera, _STRAND_FINE
        points = self._points @ turn.T + shift_m
        ahead = camera.distance_m - points[..., 2]
        column = points[..., 0] / ahead * camera.focal_px + WIDTH_PX / 2
        row = (camera.height_m - points[..., 1]) / ahead * camera.focal_px + HEIGHT_PX / 2
        places = np.round(np.stack([column, row], -1) * fine * 16).astype(np.int32)
        alpha = np.zeros((HEIGHT_PX * fine, WIDTH_PX * fine), np.float32)
        for strand, opacity in zip(np.ascontiguousarray(places.swapaxes(0, 1)), self._opacity):
            line = [strand.reshape(-1, 1, 2)]
            cv2.polylines(alpha, line, False, [float(opacity)], 1, cv2.LINE_8, shift=4)
        alpha = cv2.resize(alpha, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA)
        color = np.broadcast_to(np.array(_HAIR_SRGB) / 255, (*alpha.shape, 3))
        return np.concatenate([color, alpha[..., None]], -1)


def _shoulders(rng: np.random.Generator) -> RGBA:
    """A shirt behind the bust, which ends at its shoulders, down to the frame's bottom."""
    column = np.abs(np.arange(WIDTH_PX) + 0.5 - WIDTH_PX / 2) / HEIGHT_PX
    top = np.interp(column, [0, 0.2, 0.42, 0.56, 0.62], [0.9, 0.88, 0.93, 1.0, 1.3]) * HEIGHT_PX
    rows = np.arange(HEIGHT_PX)[:, None] + 0.5
    alpha = np.clip(rows - top + 0.5, 0, 1)
    folds = 1 + 0.12 * _smooth_field(rng, 9) + 0.05 * _smooth_field(rng, 120)
    color = np.clip(folds[..., None] * np.array(_SHIRT_SRGB) / 255, 0, 1)
    return np.concatenate([color, alpha[..., None]], -1)


@dataclass(frozen=True)
class FilmedRoom:
    """A performance as a webcam films it in a room."""

    performance: Performance
    room: Room
    seed: int

    def truth(self, hand_px: float = 0.0) -> Iterator[UInt8[np.ndarray, "H W 4"]]:
        """Straight-alpha frames as the room lights them, and as the camera's place shows them."""
        for frame, (moved, _) in zip(self.performance.frames, self._moves(hand_px)):
            if self.room.dim:
                level = np.round(np.arange(256) * _DIM ** (1 / _GAMMA)).astype(np.uint8)
                frame = np.concatenate([level[frame[..., :3]], frame[..., 3:]], -1)
            yield _seen(frame, moved)

    def behind(self) -> Float[np.ndarray, "H W 3"]:
        """The room alone, as a camera that stands sees it without noise."""
        return self.room.background(self._film_rng())

    def write(self, path: Path, hand_px: float = 0.0) -> None:
        """The clip: noise, a flickering lamp, JPEG as in the camera's cable, H.264 as recorded.

        `hand_px`: how far a hand moves the camera.
        """
        rng = self._film_rng()
        behind = self.room.background(rng)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=FRAMES_PER_SECOND)
            stream.width, stream.height, stream.pix_fmt = WIDTH_PX, HEIGHT_PX, "yuv420p"
            stream.options = {"crf": "20"}
            for frame, (_, moved) in zip(self.truth(hand_px), self._moves(hand_px)):
                share = frame[..., 3:] / 255
                seen = frame[..., :3] * share + _seen(behind, moved) * (1 - share)
                seen = seen * (1 + 0.004 * rng.standard_normal())
                # A camera smooths its noise a little.
                noise = cv2.GaussianBlur(rng.standard_normal(seen.shape), (0, 0), 0.6) * 2.1
                seen = np.clip(seen + self.room.noise_levels * noise, 0, 255).round()
                quality = [cv2.IMWRITE_JPEG_QUALITY, 88]
                packed = cv2.imencode(".jpg", seen.astype(np.uint8)[..., ::-1], quality)[1]
                picture = cv2.imdecode(packed, cv2.IMREAD_COLOR).astype(np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
            container.mux(stream.encode())

    def _film_rng(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, 13])

    def _moves(self, hand_px: float) -> list[tuple[_Homography, _Homography]]:
        """How a hand's camera moves what it shows of the person in each frame, and of the room.

        It turns about all axes and sways, which moves what is near by more: what comes of each is
        `hand_px` (one standard deviation) along each side of the picture, and about as much at its
        corners.
        """
        rng = np.random.default_rng([self.seed, 14])
        steps = rng.standard_normal((len(self.performance.frames), len(_HAND))).cumsum(0)
        steps = hand_px * np.array(_HAND) * (steps - steps.mean(0)) / steps.std(0)
        focal_px, to_right, to_bottom = _FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2
        lens = np.array([[focal_px, 0, to_right], [0, focal_px, to_bottom], [0, 0, 1]])
        moves = []
        for turn_px, (right_px, down_px, nearer_px) in zip(steps[:, :3], steps[:, 3:].tolist()):
            turned = lens @ cv2.Rodrigues(turn_px / focal_px)[0] @ np.linalg.inv(lens)
            swayed = np.array([right_px, down_px, nearer_px / focal_px])
            person, room = (turned @ _swayed(*(share * swayed)) for share in (1.0, _ROOM_MOVES))
            moves.append((person, room))
        return moves


def _swayed(right_px: float, down_px: float, larger: float) -> _Homography:
    """By pixels, and larger by such a share, about the picture's middle."""
    right_px, down_px = right_px - larger * WIDTH_PX / 2, down_px - larger * HEIGHT_PX / 2
    return np.array([[1 + larger, 0, right_px], [0, 1 + larger, down_px], [0, 0, 1]])


def _seen(picture: np.ndarray, moved: _Homography) -> np.ndarray:
    """The picture, with straight alpha if any, from where the camera is; its border goes on."""
    if (moved == np.eye(3)).all():
        return picture
    light, size = picture.astype(np.float32), (WIDTH_PX, HEIGHT_PX)
    light[..., :3] *= light[..., 3:] / 255 if light.shape[-1] == 4 else 1
    light = cv2.warpPerspective(light, moved, size, borderMode=cv2.BORDER_REPLICATE)
    if light.shape[-1] == 4:
        light[..., :3] /= np.maximum(light[..., 3:] / 255, 1e-6)
    if picture.dtype == np.uint8:
        light = np.clip(light, 0, 255).round()
    return light.astype(picture.dtype)
