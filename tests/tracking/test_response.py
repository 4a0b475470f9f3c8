"""What FaceMesh's measured response is worth on a person whose truth is known."""

from contextlib import closing

import numpy as np
import pytest
import torch

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.landmarks import facemesh_response
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson
from rgbavatar_ns.synthetic.performer.performance import perform
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.detector import FaceLandmarker
from rgbavatar_ns.tracking.fit.subject import SubjectTracker

from .acting import degrees_apart, skulls

pytest.importorskip("mediapipe", reason="the tracker needs mediapipe")
# Not among the people on whom the response was measured.
SEED, FRAMES = 4, 20


@pytest.mark.slow
def test_head_jaw_and_expressions_come_nearer_to_the_truth() -> None:
    config = DemoConfig(
        image_size=192, num_frames=4 * FRAMES, seed=SEED, glasses=False, supersampling=1
    )
    person = DemoPerson.of(config)
    names, layout = person.head.arrays.expression_names, person.head.layout
    theta = perform(layout, names, 4 * FRAMES, FRAMES, 8.0, SEED)[::4]
    found, kept = [], []
    with closing(FaceLandmarker()) as landmarker:
        for number, image in enumerate(person.draw(torch.from_numpy(theta).float())):
            alpha = image[..., 3:] / 255
            picture = (image[..., :3] * alpha + 120 * (1 - alpha)).round().astype(np.uint8)
            landmarker(picture)
            points = landmarker(picture)
            if points is not None:
                found.append(points)
                kept.append(number)
    assert len(kept) > 0.8 * len(theta)
    true, head = theta[kept], HeadModel.embedded(dtype=torch.float64)
    camera = TrackConfig(focal_px=person.camera.focal_px)

    def errors(response) -> tuple[float, float]:
        """Mean error of the skull's rotation in degrees; correlation of active expressions."""
        tracker = SubjectTracker(head, camera, response=response)
        fit = tracker.fit(np.array(found), [False] * len(found), 192, 192)
        fitted = tracker.thetas(fit)
        degrees = degrees_apart(skulls(tracker, fitted), skulls(tracker, true)).mean()
        expression = layout.slice("expression")
        active = [
            column
            for column in tracker.cost.parameters.columns
            if expression.start <= column < expression.stop and true[:, column].std() > 0.05
        ]
        pooled = np.corrcoef(fitted[:, active].ravel(), true[:, active].ravel())[0, 1]
        return float(degrees), float(pooled)

    trusting, knowing = errors(None), errors(facemesh_response())
    print(f"rotation, expressions: trusting {trusting}, knowing {knowing}")
    assert knowing[0] < 0.85 * trusting[0]
    assert knowing[1] > trusting[1] + 0.1
