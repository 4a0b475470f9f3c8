"""Cross-identity reenactment, where no truth is there: AED, APD and CSIM (paper, supplement)."""

import importlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.data import TrackedDataset
from rgbavatar_ns.drawing.compositing import composite_bytes
from rgbavatar_ns.driving import DrivingOptions
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments.seen_pose import as_seen, eyes_px
from rgbavatar_ns.export import pictures, statistics_of
from rgbavatar_ns.export.scenes import driven_by
from rgbavatar_ns.head import ThetaLayout

_Theta = Float[Tensor, "P"]
_Picture = UInt8[np.ndarray, "H W 3"]
_Face = UInt8[np.ndarray, "112 112 3"]
_Embedding = Float[np.ndarray, "D"]
_Eyes = Float[np.ndarray, "2 2"]

_REFERENCES = 8
_SIDE_PX = 112
# Where face recognition expects the eyes, the image's left one first (ArcFace's template).
_EYES_PX = np.array([[38.2946, 51.6963], [73.5318, 51.5014]])


@runtime_checkable
class PictureTracker(Protocol):
    """Finds a head's parameters in single pictures; `layout` says what they are."""

    layout: ThetaLayout

    def __call__(self, picture_rgb: _Picture) -> _Theta | None:
        """Theta of the person in the picture; None where there is no face."""
        ...


FaceRecognition = Callable[[_Face], _Embedding]
"""Whose face it is: a vector of unit length that is alike for pictures of one person, of a face
with the eyes at ArcFace's places."""


class OnnxFaceRecognition:
    """A face-recognition network in an ONNX file, run by OpenCV.

    It must take RGB [1, 3, 112, 112], (value - 127.5) / 127.5, as ArcFace's networks do. Raises
    UserError where the file cannot be read as a network.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._network = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            reason = str(error).strip().splitlines()[-1]
            raise UserError(
                f"{path} cannot be read as a face-recognition network: {reason}",
                "Name an ONNX file, for example one of ArcFace's.",
            ) from None

    def __call__(self, face_rgb: _Face) -> _Embedding:
        """The face as a vector, see `FaceRecognition`."""
        blob = cv2.dnn.blobFromImage(face_rgb, 1 / 127.5, (_SIDE_PX, _SIDE_PX), (127.5,) * 3)
        self._network.setInput(blob)
        vector = self._network.forward().reshape(-1).astype(np.float64)
        return vector / max(float(np.linalg.norm(vector)), 1e-12)


def load_tracker(name: str) -> PictureTracker:
    """Call `module:function`, which returns the tracker; raises UserError where it does not."""
    module, _, function = name.partition(":")
    try:
        tracker = getattr(importlib.import_module(module), function)()
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise UserError(
            f"The tracker {name!r} cannot be had: {error}.",
            "Name it as module:function; the function is called without arguments.",
        ) from error
    if not isinstance(tracker, PictureTracker):
        raise UserError(
            f"{name!r} returned {type(tracker).__name__}, which is no tracker of pictures.",
            "It needs a `layout` and takes a picture: see experiments/reenactment.py.",
        )
    return tracker


def tracked_distances(
    pairs: Iterable[tuple[_Picture, _Picture]], tracker: PictureTracker
) -> dict[str, float]:
    """AED and APD between the driver's pictures and the avatar's, as the same tracker sees both.

    `aed` is the mean Euclidean distance of the expression coefficients, `apd` that of all
    rotations but the eyes', axis-angle in radians. Pairs in which a face is not found are left
    out; empty where that is all of them. The numbers are in the tracker's units: those of two
    trackers cannot be compared.
    """
    layout = tracker.layout
    turns = [f.name for f in layout.fields if f.form == "axis_angle" and "eye" not in f.name]
    expression, pose = [], []
    for driver, avatar in pairs:
        seen, drawn = tracker(driver), tracker(avatar)
        if seen is None or drawn is None:
            continue
        difference = layout.split(drawn - seen)
        expression.append(float(difference["expression"].norm()))
        pose.append(float(torch.cat([difference[name] for name in turns]).norm()))
    if not expression:
        return {}
    return {"aed": float(np.mean(expression)), "apd": float(np.mean(pose))}


def identity_similarity(
    own: Sequence[_Face], drawn: Sequence[_Face], recognition: FaceRecognition
) -> float:
    """CSIM: the mean cosine between the avatar's aligned faces and the mean of its person's."""
    reference = np.mean([recognition(face) for face in own], axis=0)
    reference /= max(float(np.linalg.norm(reference)), 1e-12)
    return float(np.mean([recognition(face) @ reference for face in drawn]))


def aligned_face(picture_rgb: _Picture, eyes_px: _Eyes) -> _Face:
    """A face of 112 x 112 pixels, turned, moved and scaled so that its eyes are in place.

    `eyes_px` are the eyes' centres in the picture, the image's left one first.
    """
    # A similarity is one complex number times the place, plus another.
    (a, b), (c, d) = ((complex(*eye) for eye in eyes) for eyes in (eyes_px, _EYES_PX))
    factor = (d - c) / (b - a) if b != a else 1 + 0j
    offset = c - factor * a
    matrix = np.array(
        [[factor.real, -factor.imag, offset.real], [factor.imag, factor.real, offset.imag]]
    )
    return cv2.warpAffine(picture_rgb, matrix, (_SIDE_PX, _SIDE_PX))


def reenactment_scores(
    avatar: AvatarMethod,
    own: TrackedDataset,
    driver: TrackedDataset,
    tracker: PictureTracker | None,
    recognition: FaceRecognition | None,
) -> tuple[dict[str, float], dict[str, str]]:
    """AED, APD and CSIM of an avatar driven by another's held-out frames; why some are missing.

    The driver's numbers are taken as they are, as in the paper (by name, or of another FLAME by
    what they move), and the avatar is seen as the driver was (`seen_pose.as_seen`), in pictures of
    the driver's size. Raises UserError where the driver has no expression that the avatar knows.
    """
    avatar = avatar.cpu()
    chosen = list(driver.test or driver.train)
    options = DrivingOptions(relative="off", pose="absolute")
    mapped = driven_by(avatar, driver, chosen, statistics_of(avatar, own), 25.0, options)
    theta, cameras = as_seen(mapped, avatar, own, driver, chosen)
    drawn = list(pictures(avatar, theta, cameras, (0.0, 0.0, 0.0)))
    values, missing = {}, {}
    if tracker is None:
        missing |= dict.fromkeys(("aed", "apd"), "no tracker was named")
    else:
        values |= tracked_distances(zip((_over_black(driver, k) for k in chosen), drawn), tracker)
        if not values:
            missing |= dict.fromkeys(("aed", "apd"), "the tracker found no face")
    if recognition is None:
        missing["csim"] = "no face-recognition file was named"
        return values, missing
    train = list(own.train)
    references = train[:: max(1, len(train) // _REFERENCES)][:_REFERENCES]
    filmed_by = own.cameras.select(references)
    at = eyes_px(avatar.head, avatar.identity, own.theta[references], filmed_by)
    faces = [aligned_face(_over_black(own, k), eyes) for k, eyes in zip(references, at)]
    at = eyes_px(avatar.head, avatar.identity, theta, cameras)
    reenacted = [aligned_face(picture, eyes) for picture, eyes in zip(drawn, at)]
    values["csim"] = identity_similarity(faces, reenacted, recognition)
    return values, missing


def _over_black(dataset: TrackedDataset, position: int) -> _Picture:
    return composite_bytes(dataset.read_image(position), (0.0, 0.0, 0.0))
