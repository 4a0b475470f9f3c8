"""Landmarks read from bytes are those that protobuf reads."""

import numpy as np
import pytest

from rgbavatar_ns.tracking.face.landmark_bytes import decoded, positions_of

landmark_pb2 = pytest.importorskip("mediapipe.framework.formats.landmark_pb2")


def _message(points, **more):
    message = landmark_pb2.NormalizedLandmarkList()
    for x, y, z in points:
        message.landmark.add(x=x, y=y, z=z, **more)
    return message


@pytest.mark.parametrize("more", [{}, {"visibility": 0.5}, {"visibility": 0.5, "presence": 1.0}])
def test_positions_are_protobuf_s(more):
    points = np.random.default_rng(0).normal(size=(478, 3)).astype(np.float32)
    points[3] = 0  # fields that are set are written, also where they are 0
    found = positions_of(_message(points.tolist(), **more).SerializeToString())
    assert found is not None
    assert np.array_equal(found, points[:, :2].astype(np.float64))


def test_a_form_that_is_not_known_is_left_to_protobuf():
    message = _message([(0.25, 0.5, 0.0)])
    message.landmark.add(y=0.75)  # a record of another length
    assert positions_of(message.SerializeToString()) is None
    assert decoded(message.SerializeToString()).tolist() == [[0.25, 0.5], [0.0, 0.75]]
    other = landmark_pb2.NormalizedLandmarkList()
    other.landmark.add(x=0.25, z=0.5, visibility=0.125)  # as long, other fields
    assert positions_of(other.SerializeToString()) is None
    assert decoded(other.SerializeToString()).tolist() == [[0.25, 0.0]]


def test_no_landmarks_are_none():
    assert decoded(b"").shape == (0, 2)
