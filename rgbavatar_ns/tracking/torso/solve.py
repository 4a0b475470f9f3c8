"""The body's motion out of the points that were followed, once it is known how it stands."""

from collections.abc import Callable, Sequence

import numpy as np

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.follow import BodySighting
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion, fit_rigid_motion


def run_motions(
    body: BodyMesh,
    camera: StillCamera,
    scale: float,
    run: Sequence[BodySighting],
    start: RigidMotion,
    along: Sequence[RigidMotion],
    visited: Callable[[], None],
) -> list[RigidMotion | None]:
    """How the body moves from the first frame of a run to each; None where it was not found.

    `camera` is the source's, `scale` the size of the pictures in which points were followed by the
    source's. `start` places the body at rest in the first frame: how deep points lie follows from
    it, and so how far a turn carries them. Lost, it is looked for where `along`, which
    also counts from the first, goes. `visited` is called at each frame.
    """
    motions: list[RigidMotion | None] = []
    last, since, pivot = RigidMotion.none(), RigidMotion.none(), start(body.neck_m)
    places_m, near, certainty = np.zeros((0, 3)), np.zeros(0, bool), np.zeros((0, 2, 2))
    first = None
    for sighting, way in zip(run, along):
        visited()
        # Lost, it goes on as the outline does.
        onward, since = way.after(since.undone()).after(last), way
        last = onward if motions and motions[-1] is None else last
        if sighting.of_first and first is not None:
            places_m, near, certainty = first
        chosen = sighting.chosen_px
        found, fitted = not motions and chosen is not None and len(chosen) > 0, None
        if len(places_m):
            seen = near & np.isfinite(sighting.seen_px[:, 0])
            fitted = fit_rigid_motion(
                places_m[seen],
                sighting.seen_px[seen],
                certainty[seen],
                camera,
                scale,
                last,
                pivot,
            )
            found = fitted is not None
        last = onward if fitted is None else fitted[0]
        motions.append(last if found else None)
        if sighting.chosen_px is not None:
            places_m, near = np.zeros((0, 3)), np.zeros(0, bool)
            if len(sighting.chosen_px):
                places_m, near = body.lifted(sighting.chosen_px, last.after(start), camera)
                places_m = last.undone()(places_m)
                assert sighting.certainty is not None
                certainty = sighting.certainty
                first = first or (places_m, near, certainty)
    return motions
