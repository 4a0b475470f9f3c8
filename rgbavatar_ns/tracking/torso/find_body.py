"""The reading of a clip for its body: how it moves, where the shoulders are, what stands still."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from rgbavatar_ns.files import atomic_write, digest
from rgbavatar_ns.reading import load_arrays
from rgbavatar_ns.tracking.face.clip import ClipLandmarks
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.resumable_run import GO_ON, ResumableRun, stage_damage_told
from rgbavatar_ns.tracking.threads import in_background
from rgbavatar_ns.tracking.torso.body_mesh import NECK, BodyMesh
from rgbavatar_ns.tracking.torso.follow import BodyFollower, BodySighting, MatteOf
from rgbavatar_ns.tracking.torso.place import BodyPlaces, SeenShoulders, place_body
from rgbavatar_ns.tracking.torso.shape import ShoulderLine, shoulder_line, shoulders_up_cm
from rgbavatar_ns.tracking.torso.shoulders import ShoulderFinder

_SIDE_PX, _AHEAD = 640, 4
# In how many frames the shoulders are looked for, spread over the clip: they tell only how the
# body stands on the whole.
_SHOULDER_FRAMES = 24
_MOST_BYTES = 1 << 32
_Seen = tuple[list[BodySighting], list[SeenShoulders], list[ShoulderLine]]


def find_body(
    source: FrameSource,
    run: ResumableRun,
    tracker: SubjectTracker,
    fit: ClipFit,
    found: ClipLandmarks,
    matte_of: MatteOf,
    advance: Callable[[int], None],
) -> BodyPlaces:
    """Where the body under the fitted heads is in every frame.

    `matte_of` gives the person's alpha of a picture. `advance` is told how many frames are done.
    What was seen is a stage of `run`.
    """
    heads, identity = tracker.thetas(fit), fit.subject.identity
    body = BodyMesh.of(tracker.head, identity)
    chains = [tracker.mesh_landmarks.chain(theta, identity) for theta in heads]
    neck_m = np.array([chain.placed[NECK] for chain in chains])

    def look(key: str) -> str:
        reading = _Reading(tracker, fit, found, body, neck_m, matte_of)
        # The matrices are small: more threads would only wait for each other.
        with threadpool_limits(1):
            seen = reading.read(source, advance)
        name = f"body_{key[:16]}.npz"
        with atomic_write(run.folder / name, remedy=GO_ON) as partial:
            np.savez(partial, **_packed(*seen))
        return name

    made_from = digest([repr(found.frame_index), heads, identity])
    sightings, shoulders, lines = _load(run.folder / run.stages.run("body", made_from, look))
    advance(len(found))
    camera = fit.subject.camera
    with threadpool_limits(1):
        places = place_body(body, camera, sightings, neck_m, shoulders)
        up_cm = shoulders_up_cm(body, camera, lines, places.rotation)
    return replace(places, shoulders_up_cm=up_cm)


class _Reading:
    """One pass over the tracked frames."""

    def __init__(
        self,
        tracker: SubjectTracker,
        fit: ClipFit,
        found: ClipLandmarks,
        body: BodyMesh,
        neck_m: np.ndarray,
        matte_of: MatteOf,
    ) -> None:
        self._tracker, self._fit, self._found = tracker, fit, found
        self._body, self._neck_m, self._matte_of = body, neck_m, matte_of
        self._scale = min(1.0, _SIDE_PX / max(found.width, found.height))

    def read(self, source: FrameSource, advance: Callable[[int], None]) -> _Seen:
        """What is seen of the body in every frame, and of the shoulders in some."""
        found, place = self._found, {index: k for k, index in enumerate(self._found.frame_index)}
        every = max(1, len(found) // _SHOULDER_FRAMES)
        sightings: list[BodySighting] = []
        shoulders: list[SeenShoulders] = []
        lines: list[ShoulderLine] = []
        small = self._fit.subject.camera.scaled(self._scale)
        pose = ShoulderFinder()
        try:
            follow = BodyFollower(self._body, self._fit.subject.camera, self._scale, self._matte_of)
            frames = in_background(source.read(place.__contains__, _SIDE_PX), _AHEAD)
            with closing(frames):
                for k, frame in enumerate(frames):
                    cut = k == 0 or found.clip[k] != found.clip[k - 1]
                    pixels = partial(self._tracker.vertices_px, self._fit, k)
                    image = frame.image_rgb
                    sightings.append(follow(image, self._neck_m[k], pixels, cut))
                    if k % every == 0:
                        lines.append(
                            shoulder_line(k, self._matte_of(image), self._neck_m[k], small)
                        )
                        if (seen := pose(image)) is not None:
                            size = np.array([frame.width, frame.height])
                            shoulders.append(SeenShoulders(k, seen[0] * size, seen[1]))
                    advance(k + 1)
                    if k + 1 == len(found):
                        break
        finally:
            pose.close()
        return sightings, shoulders, lines


def _packed(
    sightings: Sequence[BodySighting],
    shoulders: Sequence[SeenShoulders],
    lines: Sequence[ShoulderLine],
) -> dict[str, np.ndarray]:
    """Plain arrays; frames that chose no points have a count of -1."""
    no_points, no_certainty = np.zeros((0, 2)), np.zeros((0, 2, 2))
    chosen = [no_points if one.chosen_px is None else one.chosen_px for one in sightings]
    certain = [no_certainty if one.certainty is None else one.certainty for one in sightings]
    return {
        "run": np.array([one.run for one in sightings]),
        "background_px": np.array([one.background_px for one in sightings]),
        "seen": np.array([len(one.seen_px) for one in sightings]),
        "seen_px": np.concatenate([no_points, *(one.seen_px for one in sightings)]),
        "chosen": np.array(
            [-1 if one.chosen_px is None else len(one.chosen_px) for one in sightings]
        ),
        "chosen_px": np.concatenate([no_points, *chosen]),
        "certainty": np.concatenate([no_certainty, *certain]),
        "shoulder_frame": np.array([one.position for one in shoulders], np.int64),
        "shoulders_px": np.array([one.shoulders_px for one in shoulders]).reshape(-1, 2, 2),
        "line_frame": np.array([one.position for one in lines], np.int64),
        "line_cm": np.array([one.above_cm for one in lines]),
        "yaw_rad": np.array([one.yaw_rad for one in shoulders], np.float64),
    }


def _load(path: Path) -> _Seen:
    """What `_packed` made; UserError where the file holds anything else."""
    with stage_damage_told(path, "body that was seen"):
        return _unpacked(load_arrays(path, _MOST_BYTES))


def _unpacked(arrays: Mapping[str, np.ndarray]) -> _Seen:
    seen_at, chosen_at = (np.cumsum(arrays[name].clip(0)) for name in ("seen", "chosen"))
    seen_px = np.split(arrays["seen_px"], seen_at)[:-1]
    chosen_px = np.split(arrays["chosen_px"], chosen_at)[:-1]
    certainty = np.split(arrays["certainty"], chosen_at)[:-1]
    sightings = [
        BodySighting(
            int(arrays["run"][k]),
            seen_px[k],
            chosen_px[k] if arrays["chosen"][k] >= 0 else None,
            certainty[k] if arrays["chosen"][k] >= 0 else None,
            float(arrays["background_px"][k]),
        )
        for k in range(len(arrays["run"]))
    ]
    rows = zip(arrays["shoulder_frame"], arrays["shoulders_px"], arrays["yaw_rad"])
    shoulders = [SeenShoulders(int(k), px, float(yaw)) for k, px, yaw in rows]
    heights = zip(arrays["line_frame"], arrays["line_cm"])
    return sightings, shoulders, [ShoulderLine(int(k), above) for k, above in heights]
