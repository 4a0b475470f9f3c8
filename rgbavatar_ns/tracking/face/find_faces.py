"""The first reading of a clip: every frame's faces and irises, kept on disk as it goes on."""

from collections.abc import Callable, Generator
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.tracking.face.clip import SeenFaces
from rgbavatar_ns.tracking.face.detector import MAX_SIDE_PX, FaceLandmarker
from rgbavatar_ns.tracking.face.iris import FoundIrises, find_irises
from rgbavatar_ns.tracking.input.video import FrameSource, SourceFrame
from rgbavatar_ns.tracking.resumable_run import GO_ON, ResumableRun
from rgbavatar_ns.tracking.threads import InBackground

# FaceMesh goes on from the frame before, so a run that was interrupted could not be continued
# alike. About every so many frames a fresh FaceMesh takes over: it looks at the last few frames
# beside the old one (after 8 they agree to .05 pixels) and takes over only if both see the same
# faces. From there a later run can go on.
BLOCK_FRAMES, _WARM_UP = 256, 8
_AGREE_SHARE = 0.03
_AHEAD = 4
# Share of a picture that is transparent where its alpha is a matte: round corners are none.
_LEAST_ROOM = 0.02
_SHARPNESS_PX = 96
_Block = tuple[SeenFaces, tuple[int, int] | None]
"""Some frames' faces; the last block tells the frames' width and height."""
_NONE = np.zeros(0, np.int64)
_NO_IRISES = np.zeros((0, 2, 2))
_NO_FRAMES = SeenFaces(
    *(_NONE, _NONE, np.zeros(0), np.zeros(0, bool), np.zeros((0, 478, 2))),
    *(_NO_IRISES, _NO_IRISES, np.zeros(0)),
)


def find_faces(
    source: FrameSource,
    run: ResumableRun,
    advance: Callable[[int], None],
    block_frames: int = BLOCK_FRAMES,
) -> tuple[SeenFaces, int, int]:
    """All faces of all frames, with the frames' width and height.

    `advance` is told how many frames are done. Each block of frames is a stage of `run`, and one
    that is done is not looked at again. Raises UserError for what cannot be read.
    """
    blocks: list[dict[str, Any]] = []
    found: Generator[_Block, None, None] | None = None
    start = 0

    def look(key: str) -> dict[str, Any]:
        nonlocal found
        if found is None:
            advance(start)
            found = _blocks(source, start, advance, block_frames)
        faces, size = next(found)
        path = run.folder / f"faces_{start:08d}.npz"
        with atomic_write(path, remedy=GO_ON) as partial:
            np.savez(partial, **vars(faces))
        notes = [] if size is None else list(source.notes)
        return {"file": path.name, "frames": len(faces), "size": size, "notes": notes}

    try:
        while not blocks or blocks[-1]["size"] is None:
            # A stage of a run that was begun before irises were found has another name.
            blocks.append(run.stages.run(f"faces and irises from frame {start}", None, look))
            start += blocks[-1]["frames"]
    finally:
        if found is not None:
            found.close()
    source.notes[:] = blocks[-1]["notes"]
    advance(start)
    faces = SeenFaces.joined([SeenFaces.load(run.folder / block["file"]) for block in blocks])
    return faces, *blocks[-1]["size"]


def _blocks(
    source: FrameSource, start: int, advance: Callable[[int], None], block_frames: int
) -> Generator[_Block, None, None]:
    """From frame `start` on; only the last block may hold none."""
    border, size = start + block_frames, (0, 0)
    seen: list[SeenFaces] = []
    landmarker, fresh = FaceLandmarker(), None
    frames = InBackground(source.read(lambda index: index >= start - _WARM_UP, MAX_SIDE_PX), _AHEAD)
    try:
        for frame in frames:
            faces = landmarker.faces(frame.image_rgb)
            size = frame.width, frame.height
            if frame.index < start:
                continue
            seen.append(_faces_in(frame, faces))
            advance(frame.index + 1)
            if frame.index < border - _WARM_UP:
                continue
            fresh = fresh or FaceLandmarker()
            again = fresh.faces(frame.image_rgb)
            if frame.index == border - 1:
                if _agree(faces, again):
                    yield SeenFaces.joined(seen), None
                    landmarker.close()
                    landmarker, seen = fresh, []
                else:
                    fresh.close()
                fresh, border = None, border + block_frames
        yield SeenFaces.joined([_NO_FRAMES, *seen]), size
    finally:
        frames.close()
        landmarker.close()
        if fresh is not None:
            fresh.close()


def _faces_in(frame: SourceFrame, faces: Float[np.ndarray, "N 478 2"]) -> SeenFaces:
    """What is kept of one frame; its image is looked at for irises and sharpness."""
    image = frame.image_rgb
    size = np.array([image.shape[1], image.shape[0]])
    irises = FoundIrises.stacked([find_irises(image, face * size) for face in faces])
    return SeenFaces(
        np.array([len(faces)], dtype=np.int64),
        np.array([frame.clip], dtype=np.int64),
        np.array([np.nan if frame.time_s is None else frame.time_s], dtype=np.float64),
        np.array([frame.alpha is not None and bool((frame.alpha < 128).mean() > _LEAST_ROOM)]),
        faces,
        irises.centers / size,
        irises.sigma,
        np.array([sharpness(image, face) for face in faces], dtype=np.float64),
    )


def sharpness(image_rgb: UInt8[np.ndarray, "H W 3"], face: Float[np.ndarray, "478 2"]) -> float:
    """How strong fine detail is in a face (variance of the Laplacian over the image's own).

    `face` in shares of the image. 0 for a face outside of it.
    """
    height, width = image_rgb.shape[:2]
    low = np.clip(np.floor(face.min(0) * (width, height)), 0, None).astype(int)
    # Below 0 an end would be counted from the image's other side.
    high = np.clip(np.ceil(face.max(0) * (width, height)), 0, None).astype(int)
    part = image_rgb[low[1] : high[1], low[0] : high[0]]
    if min(part.shape[:2]) < 2:
        return 0.0
    grey = cv2.cvtColor(np.ascontiguousarray(part), cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, (_SHARPNESS_PX, _SHARPNESS_PX), interpolation=cv2.INTER_AREA)
    detail = cv2.Laplacian(grey.astype(np.float32), cv2.CV_32F)
    return float(detail.var() / (grey.var() + 1.0))


def _agree(a: Float[np.ndarray, "N 478 2"], b: Float[np.ndarray, "M 478 2"]) -> bool:
    """Whether both see the same faces, in any order."""
    return len(a) == len(b) and all(
        (np.abs(b - face).max((1, 2)) < _AGREE_SHARE * np.ptp(face[:, 1])).any() for face in a
    )
