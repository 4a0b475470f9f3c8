"""What `rgbavatar render` shows: who performs, seen from where, frame by frame."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.avatar.orbit import head_centre, orbit
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.drawing.compositing import composite_bytes
from rgbavatar_ns.drawing.contact_sheet import scaled
from rgbavatar_ns.driving.theta_map import MappedTheta, ThetaNames, theta_map
from rgbavatar_ns.driving.transfer import (
    DrivingOptions,
    drive,
    told_beyond,
)
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.drawing import Color, Picture, pictures
from rgbavatar_ns.export.views import FOUR_VIEWS_DEGREES, read_camera_path, swing
from rgbavatar_ns.head import turn_seen
from rgbavatar_ns.kernels import PinholeCameras

TURNTABLE_FRAMES = 72
_ORBIT_DEGREES = (35.0, 12.0)


@dataclass(frozen=True)
class Scene:
    """F frames of a performance, with one camera for all or one for each."""

    theta: Float[Tensor, "F H"]
    cameras: PinholeCameras
    frames_per_second: float

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.theta)

    def held(self, frame: int, count: int) -> "Scene":
        """The expression of one frame for `count` frames; raises UserError if there is none."""
        if not 0 <= frame < len(self):
            raise UserError(
                f"There is no frame {frame} to hold.", f"Name one from 0 to {len(self) - 1}."
            )
        return replace(
            self, theta=self.theta[frame].expand(count, -1), cameras=self.camera_of(frame)
        )

    def camera_of(self, frame: int) -> PinholeCameras:
        """The camera that sees this frame."""
        return self.cameras.select([frame if len(self.cameras.focal_px) > 1 else 0])


def chosen_frames(
    count: int, frames: tuple[int, int] | None, default: Sequence[int]
) -> tuple[int, ...]:
    """Positions from the first to before the last named; `default` where none are named.

    Raises UserError where they are not there.
    """
    if frames is None:
        return tuple(default)
    first, end = frames
    if not 0 <= first < end <= count:
        raise UserError(
            f"There are no frames {first} to {end} among {count}.",
            "Name the first frame and the one after the last.",
        )
    return tuple(range(first, end))


def driven_by(
    avatar: AvatarMethod,
    driver: TrackedDataset,
    chosen: Sequence[int],
    own: TrainingStatistics,
    frames_per_second: float,
    options: DrivingOptions,
) -> MappedTheta:
    """The avatar's theta of a driver's frames; references are taken over all its frames.

    Raises UserError where no expression of the driver is known to the avatar.
    """
    mapped = theta_map(driver.layout, driver.arrays, avatar)(driver.theta)
    # What each camera saw is smoothed by itself: of several, a moment's rows lie side by side.
    when = driver.films, driver.moments
    names = avatar.head.arrays.expression_names
    mapped = drive(mapped, avatar.layout, own, frames_per_second, options, *when, names)
    return replace(mapped, theta=mapped.theta[list(chosen)])


def room(avatar: AvatarMethod, scene: Scene, seen: TrainingStatistics) -> Float[Tensor, "2 F 2"]:
    """How far each frame's camera may turn about the head to stay where the avatar holds.

    Lowest and highest, yaw and pitch in degrees; zero is always among them.
    """
    there = turn_seen(scene.theta, scene.cameras.world_to_camera, avatar.layout)[:, :2]
    low, high = seen.turn_reach()
    return torch.stack([(low - there).clamp(max=0), (high - there).clamp(min=0)])


def turned(
    avatar: AvatarMethod,
    scene: Scene,
    seen: TrainingStatistics | None,
    yaw_degrees: Float[Tensor, "F"],
    pitch_degrees: Float[Tensor, "F"],
) -> Scene:
    """The scene seen from cameras that turn about each frame's head.

    Where it is told what was seen in training, no farther than the avatar holds.
    """
    angles = torch.stack([yaw_degrees, pitch_degrees], 1)
    if seen is not None:
        low, high = room(avatar, scene, seen)
        angles = torch.minimum(torch.maximum(angles, low), high)
    centre = head_centre(avatar, scene.theta)
    return replace(scene, cameras=orbit(scene.cameras, centre, *angles.unbind(1)))


def orbiting(avatar: AvatarMethod, scene: Scene, seen: TrainingStatistics) -> Scene:
    """The camera swings to both sides and a little up and down, once over the scene."""
    sideways, upwards = _ORBIT_DEGREES
    to_and_fro = swing(len(scene))
    up_and_down = upwards * to_and_fro.roll(-(len(scene) // 4))
    return turned(avatar, scene, seen, sideways * to_and_fro, up_and_down)


def turntable(
    avatar: AvatarMethod, scene: Scene, seen: TrainingStatistics, arc_degrees: float | None
) -> Scene:
    """The camera goes to and fro about the head, as far as the avatar holds, once over the scene.

    With an arc so far, whatever was filmed; with one of 360 degrees once around. What no camera
    saw in training, such as the back of the head, has no learned looks.
    """
    level, to_and_fro = torch.zeros(len(scene)), swing(len(scene))
    if arc_degrees is None:
        low, high = room(avatar, scene, seen)[..., 0]
        yaw = torch.where(to_and_fro < 0, -low, high) * to_and_fro
    elif arc_degrees >= 360:
        yaw = torch.arange(len(scene)) * (360 / len(scene))
    else:
        yaw = to_and_fro * (arc_degrees / 2)
    return turned(avatar, scene, None, yaw, level)


def told_beyond_film(
    avatar: AvatarMethod, scene: Scene, seen: TrainingStatistics, what: str = "pictures"
) -> str:
    """What of the scene goes beyond the film, in a line that calls its pictures `what`.

    Empty where nothing does.
    """
    turns = turn_seen(scene.theta, scene.cameras.world_to_camera, avatar.layout)
    names = ThetaNames.of(avatar.layout, avatar.head.arrays).numbers
    return told_beyond(seen, names, scene.theta, turns, what)


def along_path(path: Path, scene: Scene) -> Scene:
    """The cameras of nerfstudio's path; the performance is spread over it, or starts again."""
    cameras, frames_per_second = read_camera_path(path)
    count = len(cameras.world_to_camera)
    places = [frame % len(scene) for frame in range(count)]
    return Scene(scene.theta[places], cameras, frames_per_second)


def four_views(avatar: AvatarMethod, scene: Scene, seen: TrainingStatistics) -> Scene:
    """Each frame of the scene four times, seen from as many sides."""
    yaw, pitch = torch.tensor(FOUR_VIEWS_DEGREES).repeat(len(scene), 1).unbind(1)
    places = [frame for frame in range(len(scene)) for _ in FOUR_VIEWS_DEGREES]
    several = len(scene.cameras.world_to_camera) > 1
    cameras = scene.cameras.select(places) if several else scene.cameras
    same = replace(scene, theta=scene.theta[places], cameras=cameras)
    return turned(avatar, same, seen, yaw, pitch)


def side_by_side(avatar: AvatarMethod, views: Scene, background: Color | None) -> Iterator[Picture]:
    """The pictures of `four_views`, those of a frame in a row."""
    drawn = pictures(avatar, views.theta, views.cameras, background)
    while row := list(itertools.islice(drawn, len(FOUR_VIEWS_DEGREES))):
        yield np.concatenate(row, axis=1)


def beside_driver(
    avatar: AvatarMethod,
    scene: Scene,
    driver: TrackedDataset,
    chosen: Sequence[int],
    background: Color,
) -> Iterator[Picture]:
    """The driver's frame, brought to the scene's height, and the avatar beside it."""
    drawn = pictures(avatar, scene.theta, scene.cameras, background)
    for position, picture in zip(chosen, drawn):
        seen = composite_bytes(driver.read_image(position), background)
        yield np.concatenate([scaled(seen, len(picture) / len(seen)), picture], axis=1)
