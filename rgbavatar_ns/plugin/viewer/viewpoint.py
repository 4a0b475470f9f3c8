"""Where the viewer's camera starts: before the face."""

import math
from dataclasses import dataclass
from typing import Any

import torch

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.plugin.cameras import head_to_nerfstudio
from rgbavatar_ns.plugin.dataparser import FilmedSubject

# nerfstudio shows its world ten times as large in viser.
_VISER_PER_METRE = 10.0
_VISIBLE_HEIGHT_M = 0.45
# In front of the training cameras, whose frames the viewer also draws.
_NEARER = 0.9

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Viewpoint:
    """A camera's place and what it looks at, in nerfstudio's world, metres."""

    eye: Point
    look_at: Point

    @classmethod
    @torch.no_grad()
    def before(cls, avatar: AvatarMethod, subject: FilmedSubject) -> "Viewpoint":
        """From the first frame's camera, a little nearer than it, at the middle of the head."""
        means = avatar.gaussians(subject.theta[:1].to(avatar.identity)).means[0]
        middle = (means.amin(0) + means.amax(0)) / 2
        camera_center = torch.linalg.inv(subject.world_to_camera[0])[:3, 3]
        eye = torch.lerp(middle, camera_center.to(middle), _NEARER)
        ends = head_to_nerfstudio(torch.stack([eye, middle])).tolist()
        return cls(eye=tuple(ends[0]), look_at=tuple(ends[1]))

    def place(self, client: Any) -> None:
        """Move the camera of a browser there."""
        with client.atomic():
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position = tuple(_VISER_PER_METRE * x for x in self.eye)
            client.camera.look_at = tuple(_VISER_PER_METRE * x for x in self.look_at)
            distance = math.dist(self.eye, self.look_at)
            client.camera.fov = 2 * math.atan2(_VISIBLE_HEIGHT_M / 2, distance)
