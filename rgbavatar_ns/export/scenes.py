"""What `rgbavatar render` shows: who performs, seen from where, frame by frame."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.data.native.dataset import TrackedDataset
from rgbavatar_ns.drawing.compositing import composite_bytes
from rgbavatar_ns.drawing.contact_sheet import scaled
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export.drawing import Color, Picture, pictures
from rgbavatar_ns.export.driving import DrivingOptions, MappedTheta, ThetaNames, drive
from rgbavatar_ns.export.views import four_views, head_centre, orbit, read_camera_path, swing
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
        return replace(self, theta=self.theta[frame].expand(count, -1))


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
    avatar: Avatar,
    driver: TrackedDataset,
    chosen: Sequence[int],
    own: TrainingStatistics,
    frames_per_second: float,
    options: DrivingOptions,
) -> MappedTheta:
    """The avatar's theta of a driver's frames; references are taken over all its frames.

    Raises UserError where no expression of the driver is known to the avatar.
    """
    mapped = drive(
        driver.theta,
        ThetaNames.of(driver.layout, driver.arrays),
        ThetaNames.of(avatar.layout, avatar.head.arrays),
        own,
        frames_per_second,
        options,
    )
    return replace(mapped, theta=mapped.theta[list(chosen)])


def orbiting(avatar: Avatar, scene: Scene) -> Scene:
    """The camera swings to both sides and a little up and down, once over the scene."""
    sideways, upwards = _ORBIT_DEGREES
    yaw = swing(len(scene), sideways)
    pitch = [upwards * angle / sideways for angle in swing(len(scene), sideways)]
    pitch = pitch[len(pitch) // 4 :] + pitch[: len(pitch) // 4]
    cameras = orbit(scene.cameras, head_centre(avatar), yaw, pitch)
    return replace(scene, cameras=cameras)


def turntable(avatar: Avatar, scene: Scene, arc_degrees: float) -> Scene:
    """The camera goes around the head once over the scene, or to and fro on a part of the circle.

    What no camera saw in training, such as the back of the head, has no learned looks.
    """
    if arc_degrees >= 360:
        yaw = [360.0 * frame / len(scene) for frame in range(len(scene))]
    else:
        yaw = swing(len(scene), arc_degrees / 2)
    cameras = orbit(scene.cameras, head_centre(avatar), yaw, [0.0] * len(scene))
    return replace(scene, cameras=cameras)


def along_path(path: Path, scene: Scene) -> Scene:
    """The cameras of nerfstudio's path; the performance is spread over it, or starts again."""
    cameras, frames_per_second = read_camera_path(path)
    count = len(cameras.world_to_camera)
    places = [frame % len(scene) for frame in range(count)]
    return Scene(scene.theta[places], cameras, frames_per_second)


def side_by_side(avatar: Avatar, scene: Scene, background: Color | None) -> Iterator[Picture]:
    """Four views of each frame in a row."""
    views = four_views(scene.cameras, head_centre(avatar))
    for theta in scene.theta:
        same = theta.expand(len(views.world_to_camera), -1)
        yield np.concatenate(list(pictures(avatar, same, views, background)), axis=1)


def beside_driver(
    avatar: Avatar, scene: Scene, driver: TrackedDataset, chosen: Sequence[int], background: Color
) -> Iterator[Picture]:
    """The driver's frame, brought to the scene's height, and the avatar beside it."""
    drawn = pictures(avatar, scene.theta, scene.cameras, background)
    for position, picture in zip(chosen, drawn):
        seen = composite_bytes(driver.read_image(position), background)
        yield np.concatenate([scaled(seen, len(picture) / len(seen)), picture], axis=1)
