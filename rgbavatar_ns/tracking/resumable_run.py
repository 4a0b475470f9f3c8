"""What an interrupted run has done so far, kept in the destination until the dataset is whole."""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rgbavatar_ns.data.native.format import IMAGE_FOLDER, INDEX_FILE
from rgbavatar_ns.data.png import png_size
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking.face.clip import SeenFaces
from rgbavatar_ns.tracking.input.image_files import image_files

WORK_FOLDER = ".tracking"
_SETTINGS, _FACES_END, _PICTURES = "run.json", "faces.json", "pictures.jsonl"
_VERSION = 1
_SAMPLE_BYTES = 1 << 20


class DiskError(UserError):
    """The destination cannot be written; what is there already stays worth going on with."""


class ResumableRun:
    """The work folder in the destination: faces in blocks of frames, and which pictures are there.

    `settings` (what JSON can hold) say what is being made of what; a run goes on only with the
    same ones. Every file is written whole or not at all. Raises UserError where the destination
    cannot be written or the disk is full.
    """

    def __init__(self, dst: Path) -> None:
        self.dst = dst
        self._folder = dst / WORK_FOLDER

    @classmethod
    def open(cls, dst: Path, settings: Mapping[str, Any], overwrite: bool) -> "ResumableRun":
        """Go on with a run of the same settings, or begin one in a new or empty folder.

        A folder with anything else in it is refused, unless `overwrite`.
        """
        run = cls(dst)
        if dst.exists() and not dst.is_dir():
            raise UserError(f"{dst} is a file.", "Name a folder to write to.")
        wanted = json.loads(json.dumps({"version": _VERSION, **settings}))
        begun = run._settings()
        finished = (dst / INDEX_FILE).exists()
        if begun == wanted and (overwrite or not finished):
            return run
        if begun is not None and not finished and not overwrite:
            changed = [name for name in wanted if wanted[name] != begun.get(name)]
            raise UserError(
                f"{dst} holds an unfinished run that differs in: {', '.join(changed)}.",
                "Repeat that command to go on with it, name another folder, or allow to "
                "overwrite it (--overwrite) to start anew.",
            )
        if not overwrite and dst.is_dir() and any(dst.iterdir()):
            raise UserError(
                f"The folder {dst} is not empty.",
                "Name a new folder, or allow to overwrite the dataset in it (--overwrite).",
            )
        with telling_of_the_disk(dst):
            shutil.rmtree(run._folder, ignore_errors=True)
            run._folder.mkdir(parents=True)
            run._write(_SETTINGS, lambda file: file.write(json.dumps(wanted).encode()))
        return run

    def save_faces(self, start: int, faces: SeenFaces, width: int, height: int) -> None:
        """Keep the block of frames that begins with frame `start`."""
        arrays = {item.name: getattr(faces, item.name) for item in fields(faces)}
        arrays["size"] = np.array([width, height])
        with telling_of_the_disk(self.dst):
            self._write(f"faces_{start:08d}.npz", lambda file: np.savez(file, **arrays))

    def frames_with_faces(self) -> int:
        """How many frames, from the first on, have been looked at."""
        return sum(len(block) for block, _ in self._blocks())

    def faces_are_complete(self, notes: Sequence[str]) -> None:
        """All frames have been looked at."""
        content = json.dumps(list(notes)).encode()
        with telling_of_the_disk(self.dst):
            self._write(_FACES_END, lambda file: file.write(content))

    def all_faces(self) -> tuple[SeenFaces, int, int, list[str]] | None:
        """Faces, the frames' width and height and notes on the source; None if not complete."""
        try:
            notes = json.loads((self._folder / _FACES_END).read_text())
        except FileNotFoundError:
            return None
        blocks = self._blocks()
        width, height = blocks[-1][1]
        return SeenFaces.joined([block for block, _ in blocks]), width, height, notes

    def pictures(self, made_from: str) -> dict[int, dict[str, Any]]:
        """By frame, what was noted down about each picture that is there and whole.

        `made_from` names the fit; pictures that were made from another one do not count.
        """
        notebook = self._folder / _PICTURES
        lines = notebook.read_text().splitlines() if notebook.exists() else []
        first = json.dumps({"made_from": made_from})
        noted, whole = {}, [f"{first}\n"]
        for line in lines[1:] if lines[:1] == [first] else ():
            try:
                fact = json.loads(line)
                frame = int(fact.pop("frame"))
                png_size(picture_path(self.dst, frame))
            except (ValueError, UserError):
                continue
            noted[frame] = fact
            whole.append(f"{line}\n")
        # Written anew, since an interruption may have cut its last line.
        with telling_of_the_disk(self.dst):
            self._write(_PICTURES, lambda file: file.write("".join(whole).encode()))
        return noted

    def note_picture(self, frame: int, facts: Mapping[str, Any]) -> None:
        """The frame's picture is in its place."""
        line = json.dumps({"frame": frame, **facts}) + "\n"
        with telling_of_the_disk(self.dst), (self._folder / _PICTURES).open("a") as file:
            file.write(line)

    def close(self) -> None:
        """The dataset is whole: the work folder is not needed any more."""
        shutil.rmtree(self._folder, ignore_errors=True)

    @contextmanager
    def in_vain_if_it_fails(self) -> Iterator[None]:
        """A user's error in here leaves nothing worth going on with, so nothing stays behind."""
        try:
            yield
        except DiskError:
            raise
        except UserError:
            self.close()
            if self.dst.is_dir() and not any(self.dst.iterdir()):
                self.dst.rmdir()
            raise

    def _settings(self) -> dict[str, Any] | None:
        try:
            return json.loads((self._folder / _SETTINGS).read_text())
        except (OSError, ValueError):
            return None

    def _blocks(self) -> list[tuple[SeenFaces, tuple[int, int]]]:
        blocks, expected = [], 0
        for path in sorted(self._folder.glob("faces_*.npz")):
            if int(path.stem.split("_")[1]) != expected:
                break
            with np.load(path, allow_pickle=False) as file:
                block = SeenFaces(*(file[item.name] for item in fields(SeenFaces)))
                width, height = file["size"].tolist()
            blocks.append((block, (width, height)))
            expected += len(block)
        return blocks

    def _write(self, name: str, write: Callable[[BinaryIO], object]) -> None:
        partial = self._folder / f"{name}.partial"
        with partial.open("wb") as file:
            write(file)
        os.replace(partial, self._folder / name)


def picture_path(dst: Path, frame: int) -> Path:
    """Where a frame's picture lies in a dataset."""
    return dst / IMAGE_FOLDER / f"{frame:05d}.png"


@contextmanager
def telling_of_the_disk(dst: Path) -> Iterator[None]:
    """Turn a failure to write into the user's error."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskError(
                f"There is no space left to write to {dst}.",
                "Free some space and give the same command again: it goes on from here.",
            ) from None
        raise DiskError(
            f"The folder {dst} cannot be written to: {error.strerror or error}.",
            "Name a folder that you may write to.",
        ) from None


def fingerprint(path: Path) -> str:
    """What tells one source from another: of a file its size and samples of its content, of a
    folder its images' names, sizes and times."""
    digest = hashlib.sha256()
    if path.is_dir():
        for image in image_files(path):
            facts = image.stat()
            digest.update(f"{image.name}|{facts.st_size}|{facts.st_mtime_ns}\n".encode())
        return digest.hexdigest()
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            digest.update(str(size).encode())
            for share in range(5):
                file.seek(max(0, size - _SAMPLE_BYTES) * share // 4)
                digest.update(file.read(_SAMPLE_BYTES))
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}.", "Check the file.") from None
    return digest.hexdigest()
