"""What a 3DMM is: the head model, its parameters' layout, UV anchors and tangent frames."""

from rgbavatar_ns.head.anchors import UVAnchors, uv_anchors
from rgbavatar_ns.head.arrays import HeadArrays
from rgbavatar_ns.head.frames import frame_quats_wxyz, tangent_frames
from rgbavatar_ns.head.layout import ThetaField, ThetaLayout
from rgbavatar_ns.head.model import HeadModel

__all__ = [
    "HeadArrays",
    "HeadModel",
    "ThetaField",
    "ThetaLayout",
    "UVAnchors",
    "frame_quats_wxyz",
    "tangent_frames",
    "uv_anchors",
]
