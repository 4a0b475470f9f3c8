"""How much of the body a picture shows, and whether the matte holds more than the person."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion

_PERSON = 0.5
# Clothes and a body that leans stand out of the upright mesh, hair out of the head, by so much.
_AROUND_BODY_M, _AROUND_HEAD_M = 0.07, 0.1
# More than this beside the person, as a share of the person, is no strand or sleeve.
_BESIDE = 0.03


@dataclass(frozen=True)
class BodyShown:
    """One frame: the area of body that is seen, and what the matte holds beside the person."""

    position: int
    seen_cm2: float
    """Below the neck, in the matte and within the picture; a chest and shoulders have 800."""
    beside: float
    """Area of the matte that is neither head nor body, as a share of theirs."""

    @property
    def alone(self) -> bool:
        """Whether the matte holds one person."""
        return self.beside <= _BESIDE


def body_shown(
    position: int,
    matte: Float[np.ndarray, "h w"],
    body: BodyMesh,
    neck_m: Float[np.ndarray, "3"],
    head_px: Float[np.ndarray, "V 2"],
    camera: StillCamera,
) -> BodyShown:
    """What is shown of a body that stands upright below its neck's joint.

    The camera is the matte's, `head_px` the vertices of the whole mesh with the fitted head.
    """
    px_per_m = camera.px_per_m(neck_m[2])
    placed = RigidMotion(np.eye(3), neck_m - body.neck_m)
    torso = _silhouette(camera.project(placed(body.vertices_m)), body.faces, matte.shape)
    head = _silhouette(head_px, body.head_faces, matte.shape)
    person = matte > _PERSON
    below = np.arange(len(matte))[:, None] > camera.project(placed(body.neck_m))[1]
    seen = (torso > 0) & below & (head == 0) & person
    own = _grown(torso, _AROUND_BODY_M * px_per_m) | _grown(head, _AROUND_HEAD_M * px_per_m)
    beside = np.count_nonzero(person & (own == 0)) / max(1, np.count_nonzero(torso | head))
    return BodyShown(position, 1e4 * np.count_nonzero(seen) / px_per_m**2, beside)


def seen_cm2(shown: Sequence[BodyShown]) -> float:
    """The area of body that half of the frames show."""
    return float(np.median([one.seen_cm2 for one in shown])) if shown else 0.0


def beside_share(shown: Sequence[BodyShown]) -> float:
    """Share of frames whose matte holds more than one person's head and body."""
    return float(np.mean([not one.alone for one in shown])) if shown else 0.0


def _silhouette(
    vertices_px: Float[np.ndarray, "V 2"], faces: Int[np.ndarray, "F 3"], shape: tuple[int, ...]
) -> UInt8[np.ndarray, "h w"]:
    drawn = np.zeros(shape, np.uint8)
    corners = np.round(vertices_px[faces].clip(-(2**14), 2**14) * 8).astype(np.int32)
    for triangle in corners:
        cv2.fillConvexPoly(drawn, triangle, (1,), shift=3)
    return drawn


def _grown(mask: UInt8[np.ndarray, "h w"], by_px: float) -> UInt8[np.ndarray, "h w"]:
    reach = 2 * round(by_px) + 1
    return cv2.dilate(mask, np.ones((reach, reach), np.uint8))
