"""FlashAvatar: JPEG images, mattes and parsing masks, numbered one higher than their frames."""

from dataclasses import replace
from pathlib import Path

from rgbavatar_ns.data.importers.folder import IMPORTED_SUFFIXES, Folder
from rgbavatar_ns.data.importers.frame_files import read_frame_files
from rgbavatar_ns.data.importers.frame_folders import CHECKPOINTS, pair
from rgbavatar_ns.data.importers.source import Reading, Source, assemble
from rgbavatar_ns.errors import UserError, first_few

IMAGE_MINUS_FRAME = 1
_HELD_OUT = 500
_REGIONS = ("_neckhead", "_mouth")


def is_flashavatar(folder: Folder) -> bool:
    """`imgs` and `alpha`, or the folder above that holds such data and the tracker's."""
    return folder.has("imgs", "alpha") or folder.has("dataset", "metrical-tracker/output")


def read_flashavatar(reading: Reading) -> Source:
    """Image n belongs to frame n - 1; the last 500 frames are held out.

    With the option `region` = head the matte ends where the parsing masks end.
    """
    subject = _subject(reading.folder)
    frames = replace(subject, root=tracker_folder(reading.folder))
    files = frames.numbered(CHECKPOINTS, (".frame",))
    numbered = subject.numbered("imgs", IMPORTED_SUFFIXES)
    if numbered and numbered.keys() == files.keys():
        raise UserError(
            f"{reading} counts images and frames alike, from {min(files)} to {max(files)}, but "
            f"image n of FlashAvatar belongs to frame n - {IMAGE_MINUS_FRAME}.",
            "If image n shows frame n, number all pictures one higher; if not, the first image and "
            "the last frame belong to nothing: remove them.",
        )
    images = _of_frames(numbered)
    masks = _of_frames(subject.numbered("alpha", IMPORTED_SUFFIXES))
    regions = None
    if reading.options.region == "head":
        neckhead, mouth = (
            _of_frames(subject.numbered("parsing", IMPORTED_SUFFIXES, ending))
            for ending in _REGIONS
        )
        regions = {n: (neckhead[n], mouth[n]) for n in neckhead.keys() & mouth.keys()}
    tracked = read_frame_files(reading, files)
    records = pair(reading, tracked, images, masks, regions)
    return assemble(reading, records, tracked.arrays, tracked.identity, _HELD_OUT)


def _of_frames(numbered: dict[int, Path]) -> dict[int, Path]:
    return {number - IMAGE_MINUS_FRAME: path for number, path in numbered.items()}


def _subject(folder: Folder) -> Folder:
    """The folder of the subject's pictures."""
    if folder.has("imgs"):
        return folder
    named = sorted(path.parent for path in (folder.root / "dataset").glob("*/imgs"))
    if len(named) != 1:
        names = first_few(named) if named else "none"
        raise UserError(
            f"{folder.root} holds {len(named)} subjects: {names}.", "Name the one that is meant."
        )
    return replace(folder, root=named[0])


def tracker_folder(folder: Folder) -> Path:
    """The tracker's output for the subject, maybe outside of the folder; UserError if none."""
    subject = _subject(folder).root
    name = subject.resolve().name
    output = Path("metrical-tracker") / "output"
    places = [
        subject,
        subject / output / name,
        *sorted((subject / output).glob("*")),
        subject.resolve().parent.parent / output / name,
    ]
    for place in places:
        if (place / CHECKPOINTS).is_dir():
            return place
    raise UserError(
        f"The FlashAvatar data in {subject} has no {CHECKPOINTS} folder of the tracker.",
        f"Put metrical-tracker's output for it to {subject / output / name}.",
    )
