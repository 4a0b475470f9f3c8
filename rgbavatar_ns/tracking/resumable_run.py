"""What an interrupted run has done so far, kept in the destination until the dataset is whole."""

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rgbavatar_ns.data.native.format import INDEX_FILE, image_path
from rgbavatar_ns.data.native.writer import make_room
from rgbavatar_ns.data.png import png_size
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.files import (
    DiskError,
    Stages,
    atomic_write,
    disk_errors,
    hold_lock,
    read_json,
    write_json,
)
from rgbavatar_ns.reading import DamagedFileError

WORK_FOLDER = ".tracking"
GO_ON = "Free some space and give the same command again: it goes on from here."
_SETTINGS, _IMAGES = "run.json", "images.jsonl"


class DamagedStageError(UserError):
    """What a stage of an unfinished run has left is damaged, and was forgotten."""


@contextmanager
def stage_damage_told(path: Path, what: str) -> Iterator[None]:
    """Reading a stage's file in here, damage becomes a DamagedStageError: it holds no `what`.

    The stage, and those after it, are forgotten, so that the next run does them again.
    """
    try:
        yield
    except (DamagedFileError, KeyError, TypeError, ValueError, IndexError) as error:
        Stages(path.parent).forget_from(path.name)
        raise DamagedStageError(
            f"{path} holds no {what}: {error}.",
            "Give the same command again: it does that part, and what follows, anew.",
        ) from None


@contextmanager
def alone_in(dst: Path) -> Iterator[None]:
    """Keep other processes from tracking into the folder; UserError where one does."""

    def refuse() -> None:
        raise UserError(
            f"Another process is tracking into {dst}.",
            "Wait for it or stop it; the same command then goes on. Or name another folder.",
        )

    if dst.exists() and not dst.is_dir():
        yield  # It is refused as what it is.
        return
    lock = dst / f"{WORK_FOLDER}.lock"
    with ExitStack() as held:
        with disk_errors(dst, "Name a folder that you may write to."):
            dst.mkdir(parents=True, exist_ok=True)
            held.enter_context(hold_lock(lock, refuse))
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
            if dst.is_dir() and not any(dst.iterdir()):
                dst.rmdir()


class ResumableRun:
    """The work folder in the destination: stages that are done, and which images are there.

    Raises DiskError where the destination cannot be written or the disk is full.
    """

    def __init__(self, dst: Path) -> None:
        self.dst = dst
        self.folder = dst / WORK_FOLDER
        self.stages = Stages(self.folder)

    @classmethod
    def open(cls, dst: Path, settings: Mapping[str, Any], overwrite: bool) -> "ResumableRun":
        """Go on with a run of the same settings, or begin one in a new or empty folder.

        `settings` (what JSON can hold) say what is being made of what. A folder with anything
        else in it is refused, unless `overwrite`.
        """
        folder = dst / WORK_FOLDER
        wanted, begun = json.loads(json.dumps(settings)), read_json(folder / _SETTINGS)
        finished = (dst / INDEX_FILE).exists()
        if begun == wanted:
            # With the dataset beside it, it was stopped before it could clean up.
            return cls(dst)
        if begun is not None and not finished and not overwrite:
            changed = [name for name in wanted if wanted[name] != begun.get(name)]
            raise UserError(
                f"{dst} holds an unfinished run that differs in: {', '.join(changed)}.",
                "Repeat that command to go on with it, name another folder, or allow to "
                "overwrite it (--overwrite) to start anew.",
            )
        make_room(dst, overwrite)
        shutil.rmtree(folder, ignore_errors=True)
        write_json(folder / _SETTINGS, wanted)
        return cls(dst)

    def noted_images(self, made_from: str) -> dict[int, dict[str, Any]]:
        """By frame, what was noted about each image that is there and whole.

        `made_from` names the fit; images that were made from another one do not count.
        """
        notebook = self.folder / _IMAGES
        lines = notebook.read_text().splitlines() if notebook.exists() else []
        first = json.dumps({"made_from": made_from})
        noted, whole = {}, [first]
        for line in lines[1:] if lines[:1] == [first] else ():
            try:
                facts = json.loads(line)
                frame = int(facts.pop("frame"))
                png_size(image_path(self.dst, frame))
            except (ValueError, UserError):
                continue
            noted[frame] = facts
            whole.append(line)
        # Written anew, since an interruption may have cut its last line.
        with atomic_write(notebook, remedy=GO_ON) as partial:
            partial.write_text("\n".join([*whole, ""]))
        return noted

    def note_image(self, frame: int, facts: Mapping[str, Any]) -> None:
        """The frame's image is in its place."""
        line = json.dumps({"frame": frame, **facts}) + "\n"
        with disk_errors(self.dst, GO_ON), (self.folder / _IMAGES).open("a") as file:
            file.write(line)

    def close(self) -> None:
        """The dataset is whole: the work folder is not needed any more."""
        shutil.rmtree(self.folder, ignore_errors=True)

    @contextmanager
    def in_vain_if_it_fails(self) -> Iterator[None]:
        """A user's error in here leaves nothing worth going on with, so nothing stays behind.

        But for the disk's, and damage, which has been forgotten.
        """
        try:
            yield
        except (DiskError, DamagedStageError):
            raise
        except UserError:
            self.close()
            raise
