"""The reading of a clip for its body: how it moves, where the shoulders are, what stands still."""

from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count

import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.files import digest
from rgbavatar_ns.head.joints import NECK
from rgbavatar_ns.tracking.face.clip import ClipLandmarks
from rgbavatar_ns.tracking.fit.fit import ClipFit
from rgbavatar_ns.tracking.fit.subject import SubjectTracker
from rgbavatar_ns.tracking.input.mattes import UserMattes, given_mattes
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.resumable_run import ResumableRun
from rgbavatar_ns.tracking.stage_clock import StageClock
from rgbavatar_ns.tracking.threads import InBackground
from rgbavatar_ns.tracking.torso.body_blocks import BodyBlock
from rgbavatar_ns.tracking.torso.body_mesh import BodyMesh
from rgbavatar_ns.tracking.torso.follow import BodyFollower, BodySighting, FollowerState
from rgbavatar_ns.tracking.torso.outline_motion import (
    OutlinePatch,
    num_visits,
    outline_patch,
    outline_path,
)
from rgbavatar_ns.tracking.torso.place import ROUNDS, BodyPlaces, SeenShoulders, place_body
from rgbavatar_ns.tracking.torso.shape import ShoulderLine, shoulder_line, shoulders_up_cm
from rgbavatar_ns.tracking.torso.shoulders import ShoulderFinder
from rgbavatar_ns.tracking.torso.shown import BodyShown, beside_share, body_shown, seen_cm2

Segmentation = Callable[[UInt8[np.ndarray, "h w 3"]], Float[np.ndarray, "h w"]]
"""The person's alpha of a picture of whom no matte was given."""
BLOCK_FRAMES = 256
"""So many tracked frames are a stage of their own, which an interrupted run need not read again."""
_SIDE_PX, _AHEAD = 640, 4
# In how many frames the shoulders are looked for, spread over the clip: they tell only how the
# body stands on the whole.
_SHOULDER_FRAMES = 24
# What is looked at: of something else an unfinished run looks anew.
_LOOKED_FOR = "patterns of many points and outlines"
# Bodies are heavy: what the pattern tells is compared with the outline now and then.
_PATCH_FRAMES = 4
# The person is not alone where more of these frames show something else.
_OTHERS_SHARE = 0.05
# And where half of them do, the outline is somebody else's too.
_MANY_OTHERS_SHARE = 0.5


def find_body(
    source: FrameSource,
    run: ResumableRun,
    tracker: SubjectTracker,
    fit: ClipFit,
    found: ClipLandmarks,
    mattes: UserMattes | None,
    source_alpha: bool,
    segmented: Segmentation,
    clock: StageClock,
    block_frames: int = BLOCK_FRAMES,
) -> BodyPlaces:
    """Where the body under the fitted heads is in every frame.

    Who the person is, `mattes` say, or the film's alpha where `source_alpha`, or else `segmented`.
    The film is read in the clock's stage "body", what was seen is put together in its stage
    "place". Each block of frames is a stage of `run`, and one that is done is not looked at again.
    """
    clock.begin("body", len(found))
    heads, identity = tracker.thetas(fit), fit.subject.identity
    body = BodyMesh.of(tracker.head, identity)
    neck_m = np.array(
        [tracker.mesh_landmarks.chain(theta, identity).placed[NECK] for theta in heads]
    )
    reading = _Reading(
        tracker, fit, found, body, neck_m, mattes, source_alpha, segmented, clock.done
    )
    made_from = digest([repr(found.frame_index), heads, identity, _LOOKED_FOR])
    blocks: list[BodyBlock] = []
    reads: Generator[BodyBlock, None, None] | None = None
    start = 0

    def look(key: str) -> str:
        nonlocal reads
        if reads is None:
            clock.done(start)
            state = blocks[-1].state if blocks else FollowerState.before_the_first()
            reads = reading.blocks(source, start, state, block_frames)
        block = next(reads)
        name = f"body_{key[:16]}.npz"
        block.save(run.folder / name)
        return name

    try:
        while start < len(found):
            name = run.stages.run(f"body from frame {start}", made_from, look)
            blocks.append(BodyBlock.load(run.folder / name))
            start += block_frames
    finally:
        if reads is not None:
            reads.close()
    clock.done(len(found))
    seen, camera = BodyBlock.joined(blocks), fit.subject.camera
    beside = beside_share(seen.shown)
    # Who else is in the picture pulls at the shoulders that are found, also where no matte says so.
    shoulders = seen.shoulders if beside <= _OTHERS_SHARE else ()
    clock.begin("place", len(found))
    patches = seen.patches if beside <= _MANY_OTHERS_SHARE else ()
    visits, most = count(), ROUNDS + num_visits(len(patches)) / len(found)

    def visited() -> None:
        clock.done(int(next(visits) / most))

    scale = _followed_scale(found)
    path = outline_path(patches, neck_m, camera, found.follows(), visited)
    places = place_body(
        body, camera, scale, seen.sightings, neck_m, found.follows(), shoulders, path, visited
    )
    up_cm = shoulders_up_cm(body, camera, seen.lines, places.rotation)
    clock.done(len(found))
    return replace(
        places,
        shoulders_up_cm=up_cm,
        seen_cm2=seen_cm2(seen.shown),
        beside_share=beside,
    )


def _followed_scale(found: ClipLandmarks) -> float:
    """The size of the pictures in which the body is followed by the source's."""
    return min(1.0, _SIDE_PX / max(found.width, found.height))


@dataclass(frozen=True)
class _Reading:
    """One pass over the tracked frames."""

    tracker: SubjectTracker
    fit: ClipFit
    found: ClipLandmarks
    body: BodyMesh
    neck_m: Float[np.ndarray, "F 3"]
    mattes: UserMattes | None
    source_alpha: bool
    segmented: Segmentation
    advance: Callable[[int], None]

    def blocks(
        self, source: FrameSource, start: int, state: FollowerState, block_frames: int
    ) -> Generator[BodyBlock, None, None]:
        """What is seen of the body from a position on, where following was in that `state`."""
        found = self.found
        place = {index: k for k, index in enumerate(found.frame_index) if k >= start}
        scale = _followed_scale(found)
        camera = self.fit.subject.camera
        small, every = camera.scaled(scale), max(1, len(found) // _SHOULDER_FRAMES)
        follow = BodyFollower(self.body, camera, scale, state)
        sightings: list[BodySighting] = []
        shoulders: list[SeenShoulders] = []
        patches: list[OutlinePatch] = []
        lines: list[ShoulderLine] = []
        shown: list[BodyShown] = []
        read = source.these(place, _SIDE_PX)
        given = given_mattes(read, frozenset(place), self.mattes, self.source_alpha)
        pose = ShoulderFinder()
        try:
            with closing(InBackground(given, _AHEAD)) as frames:
                for k, (frame, level) in enumerate(frames, start):
                    cut = k == 0 or found.clip[k] != found.clip[k - 1]
                    pixels = partial(self.tracker.vertices_px, self.fit, k)
                    image, neck = frame.image_rgb, self.neck_m[k]
                    # Asked for by several, found once.
                    alpha = cache(partial(self._alpha, image, level))
                    sightings.append(follow(image, neck, alpha, pixels, cut))
                    if k % _PATCH_FRAMES == 0 or not sightings[-1].is_followed:
                        patches.append(outline_patch(k, alpha(), neck, small))
                    if k % every == 0:
                        matte, head_px = alpha(), pixels() * scale - 0.5
                        lines.append(shoulder_line(k, matte, neck, small))
                        shown.append(body_shown(k, matte, self.body, neck, head_px, small))
                        if shown[-1].alone and (seen := pose(image)) is not None:
                            size = np.array([frame.width, frame.height])
                            shoulders.append(SeenShoulders(k, seen[0] * size, seen[1]))
                    self.advance(k + 1)
                    last = k + 1 == len(found)
                    if last or (k + 1) % block_frames == 0:
                        yield BodyBlock(sightings, shoulders, patches, lines, shown, follow.state)
                        sightings, shoulders, patches, lines, shown = [], [], [], [], []
                    if last:
                        return
        finally:
            pose.close()

    def _alpha(
        self, image_rgb: UInt8[np.ndarray, "h w 3"], given: UInt8[np.ndarray, "h w"] | None
    ) -> Float[np.ndarray, "h w"]:
        """The person's alpha of a picture, in [0, 1]: as it was given, or by segmentation."""
        return self.segmented(image_rgb) if given is None else given.astype(np.float32) / 255
