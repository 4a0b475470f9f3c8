"""What a 3DMM is: the head model, its parameters' layout, UV anchors and tangent frames."""

from rgbavatar_ns.head.anchors import UVAnchors, uv_anchors
from rgbavatar_ns.head.arrays import EMBEDDED_BUST, EMBEDDED_HEAD, HeadArrays
from rgbavatar_ns.head.frames import (
    edge_rotations,
    edges_to_frame,
    frame_quats_wxyz,
    tangent_frames,
)
from rgbavatar_ns.head.identity import is_same_identity
from rgbavatar_ns.head.landmarks import SPARSE_51, LandmarkMap, facemesh_landmarks
from rgbavatar_ns.head.layout import ThetaField, ThetaLayout
from rgbavatar_ns.head.model import HeadModel
from rgbavatar_ns.head.turn import turn_range, turn_seen

__all__ = [
    "EMBEDDED_BUST",
    "EMBEDDED_HEAD",
    "SPARSE_51",
    "HeadArrays",
    "HeadModel",
    "LandmarkMap",
    "ThetaField",
    "ThetaLayout",
    "UVAnchors",
    "edge_rotations",
    "edges_to_frame",
    "facemesh_landmarks",
    "frame_quats_wxyz",
    "is_same_identity",
    "tangent_frames",
    "turn_range",
    "turn_seen",
    "uv_anchors",
]
