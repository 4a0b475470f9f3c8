"""FaceMesh's landmarks from mediapipe's own bytes.

mediapipe hands results to Python as protobuf messages. The protobuf that nerfstudio allows (3.20)
has no compiled decoder for Python 3.11, and 478 landmarks a frame took it longer than the fit.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

_TAG_BYTES = 2
_X, _Y = (2, 0x0D), (7, 0x15)
"""Place in a landmark's record, and the byte there: fields 1 and 2, four bytes each."""


def positions_of(serialized: bytes) -> Float[np.ndarray, "N 2"] | None:
    """x and y of a serialised NormalizedLandmarkList; None where its records are of mixed form."""
    if not serialized:
        return np.empty((0, 2))
    stride = _TAG_BYTES + serialized[1]
    if len(serialized) % stride or stride < _Y[0] + 5:
        return None
    records = np.frombuffer(serialized, np.uint8).reshape(-1, stride)
    known = (records[:, :_TAG_BYTES] == (0x0A, stride - _TAG_BYTES)).all()
    for place, tag in (_X, _Y):
        known = known and bool((records[:, place] == tag).all())
    if not known:
        return None
    floats = [records[:, place + 1 : place + 5].copy().view("<f4") for place, _ in (_X, _Y)]
    return np.concatenate(floats, axis=1).astype(np.float64)


def hand_over_bytes(mesh: Any) -> None:
    """Make `mesh` (FaceMesh of mediapipe 0.10) give bytes instead of messages."""
    from mediapipe.python._framework_bindings import _packet_getter

    def content(_: Any, packet: Any) -> list[bytes] | None:
        return None if packet.is_empty() else _packet_getter._get_serialized_proto_list(packet)

    mesh._get_packet_content = content


def decoded(serialized: bytes) -> Float[np.ndarray, "N 2"]:
    """x and y of every landmark, by protobuf where its form is not the usual one."""
    positions = positions_of(serialized)
    if positions is not None:
        return positions
    from mediapipe.framework.formats import landmark_pb2

    message: Any = landmark_pb2.NormalizedLandmarkList()
    message.ParseFromString(serialized)
    return np.array([(point.x, point.y) for point in message.landmark]).reshape(-1, 2)
