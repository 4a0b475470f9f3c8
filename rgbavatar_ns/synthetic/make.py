"""The demo dataset from its script: a person who does not exist, filmed by ray casting."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.native.writer import DatasetWriter, make_room
from rgbavatar_ns.head import EMBEDDED_BUST, EMBEDDED_HEAD, HeadModel
from rgbavatar_ns.head.arrays import NECK_SHIFTS
from rgbavatar_ns.head.joints import NECK
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rgbavatar_ns.kernels.types import PinholeCameras
from rgbavatar_ns.synthetic.config import DemoConfig
from rgbavatar_ns.synthetic.performer.glasses import make_glasses
from rgbavatar_ns.synthetic.performer.hair import SCALP_HAIR, make_hair_piece
from rgbavatar_ns.synthetic.performer.paint import paint_head
from rgbavatar_ns.synthetic.performer.performance import perform, with_tracker_noise
from rgbavatar_ns.synthetic.performer.surface import TrueSurface
from rgbavatar_ns.synthetic.performer.wrinkles import WRINKLES, wrinkle_activations
from rgbavatar_ns.synthetic.renderer.raycast import RayCamera
from rgbavatar_ns.synthetic.renderer.render import DemoRenderer, Moment

Progress = Callable[[int, int], None]
"""Called with (frames done, frames in all)."""

WIDE_OPEN_RAD = 0.33
_BYTES_PER_PIXEL, _MOST_BYTES = 400, 1 << 31
"""What a picture takes while it is drawn with three rays a pixel's side, and all of them may."""
_CHUNK = 16
_CAMERA_DISTANCE_M = 1.1
# How high the picture's middle lies and half of what it shows: the head, or shoulders too.
_HEAD_VIEW_M, _BUST_VIEW_M = (0.007, 0.153), (-0.08, 0.26)


def as_pinhole(camera: RayCamera) -> PinholeCameras:
    """The same camera in OpenCV's axes."""
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None]
    world_to_camera[0, 1, 3] = camera.height_m
    world_to_camera[0, 2, 3] = camera.distance_m
    half = torch.full((1, 2), camera.size / 2)
    focal_px = torch.full((1, 2), camera.focal_px)
    return PinholeCameras(world_to_camera, focal_px, half, camera.size, camera.size)


@dataclass(frozen=True)
class DemoPerson:
    """Head model, looks and renderer of the person of one config.

    What is drawn is posed by `exact_head`, the same in float64, and rounded: float32's last digits
    follow from how many frames are posed at once and from where they lie in memory.
    """

    head: HeadModel
    exact_head: HeadModel
    identity: Float[Tensor, "I"]
    renderer: DemoRenderer
    camera: RayCamera

    @classmethod
    def of(cls, config: DemoConfig) -> "DemoPerson":
        """Model, paint and light the person; a few seconds."""
        name, view_m = EMBEDDED_HEAD, _HEAD_VIEW_M
        if config.body != "none":
            name, view_m = EMBEDDED_BUST, _BUST_VIEW_M
        head = HeadModel.embedded(name=name)
        # Looks of their own, but no caricature.
        drawn = np.random.default_rng([config.seed, 0]).standard_normal(head.num_identity)
        identity = torch.from_numpy(np.clip(0.6 * drawn, -1.2, 1.2)).float()
        scalp_hair = SCALP_HAIR[config.hair]
        surface = TrueSurface(head.arrays, config.seed, config.wrinkles, scalp_hair)
        resolution = min(max(256, 2 ** int(np.ceil(np.log2(2 * config.image_size)))), 2048)
        paint = paint_head(head.arrays, resolution, config.seed, config.wrinkles, scalp_hair > 0)
        rest = torch.zeros(2, head.layout.size)
        rest[1, head.layout.slice("jaw").start] = WIDE_OPEN_RAD
        exact_head, exact_identity = HeadModel(head.arrays, torch.float64), identity.double()
        at_rest, jaw_open = exact_head(rest.double(), exact_identity).float().numpy()
        glasses = None
        if config.glasses:
            eyes = exact_head.joints(exact_identity)[3:].float().numpy()
            bridge = np.abs(at_rest[:, 0]) < 0.012
            bridge &= np.abs(at_rest[:, 1] - eyes[:, 1].mean()) < 0.008
            glasses = make_glasses(eyes[0], eyes[1], float(at_rest[bridge, 2].max()))
        bare = surface.pose(at_rest, np.zeros(len(WRINKLES))).vertices
        hair = make_hair_piece(config.hair, bare, config.seed)
        focal_px = 0.5 * config.image_size * _CAMERA_DISTANCE_M / view_m[1]
        camera = RayCamera(view_m[0], _CAMERA_DISTANCE_M, focal_px, config.image_size)
        renderer = DemoRenderer(
            surface,
            paint,
            glasses,
            hair,
            at_rest,
            jaw_open,
            camera,
            config.supersampling,
            light_follows_head=config.light == "head",
        )
        return cls(head, exact_head, identity, renderer, camera)

    def moments(self, theta: Float[Tensor, "F H"]) -> Iterator[Moment]:
        """What to draw for each theta."""
        layout = self.head.layout
        expression = theta[:, layout.slice("expression")].double().numpy()
        names = self.head.arrays.expression_names
        vertices = np.zeros((0, 0, 3), np.float32)
        activations = wrinkle_activations(expression, names)
        jaw = theta[:, layout.slice("jaw").start].double().numpy() / WIDE_OPEN_RAD
        left, right = (expression[:, names.index(f"mouthSmile{s}")] for s in ("Left", "Right"))
        smile, identity = 0.5 * (left + right), self.identity.double()
        for k in range(len(theta)):
            if k % _CHUNK == 0:
                posed = self.exact_head(theta[k : k + _CHUNK].double(), identity)
                vertices = posed.float().numpy()
            rotation, shift = self._skull(theta[k])
            yield Moment(
                tracked=vertices[k % _CHUNK],
                activations=activations[k],
                blush=float(smile[k]),
                jaw_open=float(np.clip(jaw[k], 0, 1)),
                head_rotation=rotation,
                head_shift_m=shift,
            )

    def _skull(
        self, theta: Float[Tensor, "H"]
    ) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """The rigid motion of what follows neck and body wholly."""
        parts = self.head.layout.split(theta)
        root, neck = self._joints()[:2]
        body = axis_angle_to_matrix(parts["rotation"])
        turn = axis_angle_to_matrix(parts["neck"])
        carried, neck_carried = self._carried(parts["expression"])
        neck = neck + neck_carried
        shift = body @ (neck - turn @ (neck - carried) - root) + root + parts["translation"]
        return (body @ turn).numpy(), shift.numpy()

    def _carried(
        self, expression: Float[Tensor, "E"]
    ) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """How a bust's neck shifts carry the skull, and the neck's joint; 0 for a head alone."""
        arrays = self.head.arrays
        if not arrays.has_torso:
            return torch.zeros(3), torch.zeros(3)
        columns = [arrays.expression_names.index(name) for name in NECK_SHIFTS]
        offsets = arrays.shapedirs[..., [arrays.num_identity + column for column in columns]]
        skull = arrays.vertex_groups["upper_teeth"][0]
        offsets = offsets.astype(np.float64)
        moved = np.stack([offsets[skull], np.tensordot(arrays.joint_regressor[NECK], offsets, 1)])
        carried, neck = (torch.from_numpy(moved) @ expression[columns].double()).float()
        return carried, neck

    def _joints(self) -> Float[Tensor, "J 3"]:
        """At rest, metres."""
        return self.exact_head.joints(self.identity.double()).float()

    def with_stiff_neck(self, theta: Float[Tensor, "F H"]) -> Float[Tensor, "F H"]:
        """Theta that moves the skull likewise, and everything else with it."""
        parts = self.head.layout.split(theta)
        root = self._joints()[0]
        turns, shifts = zip(*(self._skull(row) for row in theta))
        turn, shift = (torch.from_numpy(np.stack(values)) for values in (turns, shifts))
        moved = {
            "rotation": matrix_to_axis_angle(turn),
            "translation": shift - root + turn @ root,
            "neck": torch.zeros_like(parts["neck"]),
        }
        return self.head.layout.join({**parts, **moved})

    def draw(self, theta: Float[Tensor, "F H"]) -> Iterator[UInt8[np.ndarray, "S S 4"]]:
        """Images of each theta in order, a few at work at a time: as many as torch takes threads,
        or two where that would take too much memory."""
        waiting: deque[Future[np.ndarray]] = deque()
        room = _MOST_BYTES // (_BYTES_PER_PIXEL * self.camera.size**2)
        threads = min(torch.get_num_threads(), max(2, room))
        pool = ThreadPoolExecutor(threads)
        try:
            for moment in self.moments(theta):
                waiting.append(pool.submit(self.renderer.render, moment))
                if len(waiting) > 2 * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


@dataclass(frozen=True)
class DemoFilm:
    """The demo subject's performance: theta as a tracker finds it, and images when asked for."""

    person: DemoPerson
    tracked: Float[Tensor, "F H"]
    true: Float[Tensor, "F H"]
    camera: PinholeCameras

    def frames(self) -> Iterator[TrackedFrame]:
        """Render frame after frame."""
        for index, image in enumerate(self.person.draw(self.true)):
            yield TrackedFrame(index, self.tracked[index], self.camera, image)


def film_demo(config: DemoConfig, stiff_neck: bool = False) -> DemoFilm:
    """Cast, script and track the demo subject; the same config gives the same film on every run.

    On another processor a pixel's level may differ here and there.

    stiff_neck: the body turns in the neck's stead, so that the head moves as one piece, as
    trackers assume that put all of its motion into the camera.
    """
    person = DemoPerson.of(config)
    layout = person.head.layout
    acted = perform(
        layout,
        person.head.arrays.expression_names,
        config.num_frames,
        config.num_test_frames,
        config.frames_per_second,
        config.seed,
        config.body,
    )
    names = person.head.arrays.expression_names
    tracked = with_tracker_noise(acted, layout, names, config.theta_noise, config.seed)
    found, true = (torch.from_numpy(theta).float() for theta in (tracked, acted))
    if stiff_neck:
        found, true = person.with_stiff_neck(found), person.with_stiff_neck(true)
    return DemoFilm(person, found, true, as_pinhole(person.camera))


def make_demo_dataset(
    dst: str | Path,
    config: DemoConfig | None = None,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
) -> TrackedDataset:
    """Render the demo subject and write it to `dst`, which is new, empty or left unfinished.

    `overwrite` replaces a dataset that is there; anything else there is refused by UserError.

    The same config gives the same person, performance, noise and images (see `film_demo`) on every
    run. Calls `progress(frames done, frames in all)` after each frame.
    """
    config = config or DemoConfig()
    make_room(Path(dst), overwrite)
    film = film_demo(config)
    head, size = film.person.head, config.image_size
    writer = DatasetWriter(
        dst,
        head.arrays,
        film.person.identity,
        head.layout,
        size,
        size,
        overwrite=overwrite,
        frames_per_second=config.frames_per_second,
    )
    for frame in film.frames():
        writer.add(frame)
        if progress is not None:
            progress(frame.index + 1, config.num_frames)
    return writer.finish(config.num_test_frames)
