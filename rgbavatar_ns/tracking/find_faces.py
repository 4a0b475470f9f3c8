"""The first reading of a clip: every face in every frame, kept on disk as the reading goes on."""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rgbavatar_ns.tracking.face.clip import SeenFaces
from rgbavatar_ns.tracking.face.detector import MAX_SIDE_PX, FaceLandmarker
from rgbavatar_ns.tracking.input.video import FrameSource, SourceFrame
from rgbavatar_ns.tracking.resumable_run import ResumableRun
from rgbavatar_ns.tracking.threads import in_background

# FaceMesh goes on from the frame before, so a run that was interrupted could not be continued
# alike. About every so many frames a fresh FaceMesh takes over: it looks at the last few frames
# beside the old one (after 8 they agree to .05 pixels) and takes over only if both see the same
# faces. From there a later run can go on.
BLOCK_FRAMES, _WARM_UP = 256, 8
_AGREE_SHARE = 0.03
_AHEAD = 4
_SHARPNESS_PX = 96


def find_faces(
    source: FrameSource,
    run: ResumableRun,
    advance: Callable[[int], None],
    block_frames: int = BLOCK_FRAMES,
) -> tuple[SeenFaces, int, int]:
    """All faces of all frames, with the frames' width and height.

    `advance` is told how many frames are done. Blocks that `run` has are not looked at again.
    Raises UserError for what cannot be read.
    """
    whole = run.all_faces()
    if whole is None:
        _read_blocks(source, run, advance, block_frames)
        run.faces_are_complete(list(source.notes))
        whole = run.all_faces()
        assert whole is not None
    seen, width, height, notes = whole
    source.notes[:] = notes
    advance(len(seen))
    return seen, width, height


def _read_blocks(
    source: FrameSource, run: ResumableRun, advance: Callable[[int], None], block_frames: int
) -> None:
    start = run.frames_with_faces()
    border = start + block_frames
    block = _Block()
    landmarker, fresh = FaceLandmarker(), None
    frames = in_background(
        source.read(lambda index: index >= start - _WARM_UP, MAX_SIDE_PX), _AHEAD
    )
    try:
        for frame in frames:
            faces = landmarker.faces(frame.image_rgb)
            if frame.index < start:
                continue
            block.add(frame, faces)
            advance(frame.index + 1)
            if frame.index < border - _WARM_UP:
                continue
            fresh = fresh or FaceLandmarker()
            again = fresh.faces(frame.image_rgb)
            if frame.index == border - 1:
                if _agree(faces, again):
                    run.save_faces(start, block.faces(), *block.size)
                    landmarker.__exit__(None, None, None)
                    landmarker, start, block = fresh, border, _Block()
                else:
                    fresh.__exit__(None, None, None)
                fresh, border = None, border + block_frames
        if block:
            run.save_faces(start, block.faces(), *block.size)
    finally:
        frames.close()
        landmarker.__exit__(None, None, None)
        if fresh is not None:
            fresh.__exit__(None, None, None)


class _Block:
    """Some frames' faces on their way to the disk."""

    def __init__(self) -> None:
        self._clips: list[int] = []
        self._times: list[float] = []
        self._alphas: list[bool] = []
        self._points: list[Float[np.ndarray, "N 478 2"]] = []
        self._sharpness: list[float] = []
        self.size = (0, 0)

    def __len__(self) -> int:
        return len(self._points)

    def add(self, frame: SourceFrame, faces: Float[np.ndarray, "N 478 2"]) -> None:
        """One frame more; its picture is looked at and not kept."""
        self._clips.append(frame.clip)
        self._times.append(np.nan if frame.time_s is None else frame.time_s)
        self._alphas.append(frame.alpha is not None)
        self._points.append(faces)
        self._sharpness += [sharpness(frame.image_rgb, face) for face in faces]
        self.size = (frame.width, frame.height)

    def faces(self) -> SeenFaces:
        """As it is stored; at least one frame is needed."""
        return SeenFaces(
            np.array([len(faces) for faces in self._points], dtype=np.int64),
            np.array(self._clips, dtype=np.int64),
            np.array(self._times, dtype=np.float64),
            np.array(self._alphas, dtype=bool),
            np.concatenate(self._points),
            np.array(self._sharpness, dtype=np.float64),
        )


def sharpness(image_rgb: UInt8[np.ndarray, "H W 3"], face: Float[np.ndarray, "478 2"]) -> float:
    """How strong fine detail is in a face (variance of the Laplacian over the picture's own).

    `face` in shares of the picture. 0 for a face outside of it.
    """
    height, width = image_rgb.shape[:2]
    low = np.clip(np.floor(face.min(0) * (width, height)), 0, None).astype(int)
    high = np.ceil(face.max(0) * (width, height)).astype(int)
    part = image_rgb[low[1] : high[1], low[0] : high[0]]
    if min(part.shape[:2]) < 2:
        return 0.0
    grey = cv2.cvtColor(np.ascontiguousarray(part), cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, (_SHARPNESS_PX, _SHARPNESS_PX), interpolation=cv2.INTER_AREA)
    detail = cv2.Laplacian(grey.astype(np.float32), cv2.CV_32F)
    return float(detail.var() / (grey.var() + 1.0))


def _agree(a: Float[np.ndarray, "N 478 2"], b: Float[np.ndarray, "M 478 2"]) -> bool:
    """Whether both see the same faces, in any order."""
    if len(a) != len(b):
        return False
    for face in a:
        away = np.abs(b - face).max((1, 2))
        if not (away < _AGREE_SHARE * np.ptp(face[:, 1])).any():
            return False
    return True
