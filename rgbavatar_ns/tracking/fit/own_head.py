"""The tracker with the user's own head model in place of the embedded one."""

from pathlib import Path

import torch

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import EMBEDDED_BUST, EMBEDDED_HEAD, HeadArrays, HeadModel
from rgbavatar_ns.head.flame import load_flame
from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.face.landmark_transfer import fitted_head
from rgbavatar_ns.tracking.fit.subject import SubjectTracker


def subject_tracker(config: TrackConfig, own_head: HeadArrays | None = None) -> SubjectTracker:
    """A tracker that fits the embedded bust, with `config.head_only` the embedded head, or
    `own_head` with landmarks carried over to it.

    Raises UserError where no face is found on that head.
    """
    if own_head is None:
        name = EMBEDDED_HEAD if config.head_only else EMBEDDED_BUST
        return SubjectTracker(HeadModel.embedded(torch.float64, name), config)
    known = fitted_head(own_head)
    head = HeadModel(known.arrays, dtype=torch.float64)
    return SubjectTracker(head, config, known.landmarks, known.response, known.noise)


def read_own_head(path: Path | None) -> HeadArrays | None:
    """The head model that a user names: a FLAME pickle or its folder, or a dataset's head (npz).

    Pickles are read without being run (`head.safe_pickle`); FLAME gets teeth, as importers give
    it. None names none. Raises UserError for a missing or damaged file and for another one.
    """
    if path is None:
        return None
    path = Path(path).expanduser()
    if path.suffix.lower() != ".npz":
        return load_flame(path)
    if not path.is_file():
        raise UserError(
            f"There is no head model at {path}.",
            "Name a FLAME pickle or the head of a dataset (its npz file) with --flame; without "
            "it the embedded head is used.",
        )
    return HeadArrays.load(path)
