"""Interrupted runs: what is done is kept, and the end is the same."""

import errno
import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbavatar_ns.cli import track as command
from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking import TrackConfig, track_video
from rgbavatar_ns.tracking import track as track_module
from rgbavatar_ns.tracking.face.find_faces import find_faces
from rgbavatar_ns.tracking.image import outlines
from rgbavatar_ns.tracking.input.video import FrameSource
from rgbavatar_ns.tracking.resumable_run import WORK_FOLDER, ResumableRun
from rgbavatar_ns.tracking.torso.find_body import find_body

from .clips import astronaut, gradient_images, write_clip

pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
CONFIG = TrackConfig(image_size=64, key_frames=2, focal_px=500.0, identity_components=5)
FRAMES, BLOCK, BODY_BLOCK = 13, 5, 4
Progress = Callable[[str, int, int | None], None]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The portrait drifts, and is gone for two frames."""
    image = astronaut()[::2, ::2]
    frames = [np.roll(image, k // 2, axis=1) for k in range(FRAMES)]
    frames[7] = frames[8] = np.full_like(image, 90)
    return write_clip(tmp_path_factory.mktemp("clip") / "clip.mp4", frames)


def _shorten_blocks(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(track_module, "find_faces", partial(find_faces, block_frames=BLOCK))
    patch.setattr(track_module, "find_body", partial(find_body, block_frames=BODY_BLOCK))


@pytest.fixture(autouse=True)
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    _shorten_blocks(monkeypatch)


@pytest.fixture(scope="module")
def uninterrupted(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    dst = tmp_path_factory.mktemp("whole") / "set"
    with pytest.MonkeyPatch.context() as patch:
        _shorten_blocks(patch)
        track_video(clip, dst, CONFIG)
    return dst


def _interrupting(stage: str, frames: int) -> Progress:
    def progress(now: str, done: int, total: int | None) -> None:
        if now == stage and done >= frames:
            raise KeyboardInterrupt

    return progress


def _files(dst: Path) -> dict[str, bytes]:
    """Everything but the report, which holds times."""
    return {
        str(path.relative_to(dst)): path.read_bytes()
        for path in sorted(dst.rglob("*"))
        if path.is_file() and path.name != "tracking.json"
    }


def test_a_run_interrupted_in_every_stage_ends_with_the_same_files(
    clip: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    dst = tmp_path / "set"
    counted: list[tuple[str, int]] = []
    for stage, frames in (("faces", 7), ("body", 6), ("pictures", 3), ("pictures", 7)):
        with pytest.raises(KeyboardInterrupt):
            track_video(clip, dst, CONFIG, _interrupting(stage, frames))
        with pytest.raises(UserError):
            load_dataset(dst)
        assert (dst / WORK_FOLDER).is_dir()

    def count(stage: str, done: int, total: int | None) -> None:
        counted.append((stage, done))

    track_video(clip, dst, CONFIG, count)
    # No face was looked for again, and of the pictures those that were missing.
    assert counted[0] == ("faces", FRAMES)
    assert min(done for stage, done in counted if stage == "pictures") >= 6
    assert _files(dst) == _files(uninterrupted)
    assert not (dst / WORK_FOLDER).exists()
    reports = [json.loads((one / "tracking.json").read_text()) for one in (dst, uninterrupted)]
    for report in reports:
        del report["stages"], report["frames_per_second"]
    assert reports[0] == reports[1]


def test_only_the_block_that_was_begun_is_read_again(clip: Path, tmp_path: Path) -> None:
    dst = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, CONFIG, _interrupting("faces", BLOCK + 3))
    seen: list[int] = []

    def watch(stage: str, done: int, total: int | None) -> None:
        seen.append(done)
        if stage == "fit":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, CONFIG, watch)
    assert seen[:2] == [BLOCK, BLOCK + 1]


def test_of_the_body_too_only_the_block_that_was_begun_is_read_again(
    clip: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    dst = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, CONFIG, _interrupting("body", 2 * BODY_BLOCK + 2))
    seen: list[int] = []

    def watch(stage: str, done: int, total: int | None) -> None:
        if stage == "body":
            seen.append(done)

    track_video(clip, dst, CONFIG, watch)
    assert seen[:2] == [2 * BODY_BLOCK, 2 * BODY_BLOCK + 1]
    assert _files(dst) == _files(uninterrupted)


def test_other_options_or_another_video_are_refused_in_words_or_start_anew(
    clip: Path, tmp_path: Path
) -> None:
    dst = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, CONFIG, _interrupting("faces", 3))
    other = TrackConfig(image_size=96, key_frames=2, focal_px=500.0)
    with pytest.raises(UserError, match="differs in: image_size"):
        track_video(clip, dst, other)
    changed = write_clip(tmp_path / "other.mp4", [astronaut()[::4, ::4]] * 2)
    with pytest.raises(UserError, match="differs in: the video"):
        track_video(changed, dst, CONFIG)
    small = TrackConfig(image_size=48, key_frames=1, focal_px=500.0, overwrite=True)
    assert track_video(changed, dst, small).width == 48


def test_a_finished_dataset_stands_until_the_new_ones_images_begin(
    clip: Path, tmp_path: Path
) -> None:
    dst = tmp_path / "set"
    small = TrackConfig(image_size=48, key_frames=1, focal_px=500.0, max_frames=2)
    first = track_video(clip, dst, small)
    assert (first.train, first.test) == ((0,), (1,)), "of two frames one is to be scored"
    again = TrackConfig(image_size=32, key_frames=1, max_frames=2, focal_px=500.0, overwrite=True)
    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, again, _interrupting("fit", 0))
    assert load_dataset(dst).width == first.width
    with pytest.raises(UserError, match="not empty"):
        track_video(clip, dst, TrackConfig(image_size=32, max_frames=2))
    assert track_video(clip, dst, again).width == 32


def test_stopped_between_the_dataset_and_cleaning_up_the_same_call_ends_well(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dst = tmp_path / "set"
    small = TrackConfig(image_size=48, key_frames=1, focal_px=500.0, max_frames=2)

    def killed(run: ResumableRun) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as stopped:
        stopped.setattr(ResumableRun, "close", killed)
        with pytest.raises(KeyboardInterrupt):
            track_video(clip, dst, small)
    assert (dst / "dataset.json").exists()
    assert len(track_video(clip, dst, small)) == 2
    assert not (dst / WORK_FOLDER).exists()


def test_with_overwrite_a_folder_of_other_things_is_refused_before_the_work(
    clip: Path, tmp_path: Path
) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="not empty"):
        track_video(clip, tmp_path, TrackConfig(overwrite=True))
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_torn_line_and_a_torn_image_are_made_again(tmp_path: Path) -> None:
    run = ResumableRun.open(tmp_path / "set", {"a": 1}, overwrite=False)
    images = tmp_path / "set" / "images"
    images.mkdir()
    assert run.noted_images("fit") == {}
    for frame in range(3):
        cv2.imwrite(str(images / f"{frame:05d}.png"), np.zeros((4, 4, 4), np.uint8))
        run.note_image(frame, {"coverage": None})
    whole = (images / "00001.png").read_bytes()
    (images / "00001.png").write_bytes(whole[:-6])
    with (tmp_path / "set" / WORK_FOLDER / "images.jsonl").open("a") as file:
        file.write('{"frame": 2, "cov')
    assert sorted(run.noted_images("fit")) == [0, 2]
    run.note_image(7, {})
    cv2.imwrite(str(images / "00007.png"), np.zeros((4, 4, 4), np.uint8))
    assert sorted(run.noted_images("fit")) == [0, 2, 7]
    assert run.noted_images("another fit") == {}


def test_mattes_of_key_frames_are_found_once(
    clip: Path, uninterrupted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dst = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, CONFIG, _interrupting("pictures", 1))

    def never() -> None:
        raise AssertionError("the mattes of key frames were there")

    monkeypatch.setattr(outlines, "PersonMatte", never)
    track_video(clip, dst, CONFIG)
    assert _files(dst) == _files(uninterrupted)


def test_damage_of_what_was_kept_is_told_once_and_then_mended(
    clip: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    dst = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, CONFIG, _interrupting("pictures", 1))
    first = dst / WORK_FOLDER / "faces_00000000.npz"
    before = first.stat().st_mtime_ns
    for kept, told in (
        ("body_*", "body that was seen"),
        (f"faces_{BLOCK:08d}.npz", "faces that were"),
    ):
        damaged = next((dst / WORK_FOLDER).glob(kept))
        damaged.write_bytes(damaged.read_bytes()[:-40])
        with pytest.raises(UserError, match=rf"holds no {told}.*the same command again"):
            track_video(clip, dst, replace(CONFIG, overwrite=True))
    assert first.stat().st_mtime_ns == before
    track_video(clip, dst, CONFIG)
    assert _files(dst) == _files(uninterrupted)


def test_ctrl_c_ends_with_one_line_and_code_130(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*given: object, **named: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "track_video", interrupted)
    with pytest.raises(SystemExit) as told:
        command.run((tmp_path / "clip.mp4", tmp_path / "set"))
    assert told.value.code == 130
    assert "the same command goes on from there" in capsys.readouterr().err


def test_a_failure_that_repeats_leaves_nothing_behind(tmp_path: Path) -> None:
    grey = write_clip(tmp_path / "grey.mp4", gradient_images(3, 96, 96))
    with pytest.raises(UserError, match="No face"):
        track_video(grey, tmp_path / "set")
    (tmp_path / "noise.mp4").write_bytes(b"no video" * 99)
    with pytest.raises(UserError, match="cannot be read"):
        track_video(tmp_path / "noise.mp4", tmp_path / "set")
    assert not (tmp_path / "set").exists()


def test_a_destination_that_is_a_file_is_refused(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "set").write_text("mine")
    with pytest.raises(UserError, match="is a file"):
        track_video(clip, tmp_path / "set")
    assert (tmp_path / "set").read_text() == "mine"
    with pytest.raises(UserError, match="not empty"):
        track_video(clip, tmp_path)


def _failing(code: int, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every file whose name holds `name` fail to be moved into its place."""
    real = os.replace

    def replace(source: str | Path, target: str | Path) -> None:
        if name in str(target):
            raise OSError(code, os.strerror(code))
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES])
def test_a_destination_that_cannot_be_written_is_told_before_the_work(
    clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    _failing(code, "run.json", monkeypatch)
    with pytest.raises(UserError, match=r"Cannot write .*run\.json"):
        track_video(clip, tmp_path / "set", CONFIG, _interrupting("faces", 0))


@pytest.mark.parametrize("place", ["faces_", "00005.png"])
def test_after_a_full_disk_the_same_command_goes_on(
    clip: Path, tmp_path: Path, uninterrupted: Path, place: str
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        _failing(errno.ENOSPC, place, patch)
        with pytest.raises(UserError, match=r"no space left .* the same command again"):
            track_video(clip, tmp_path / "set", CONFIG)
    assert (tmp_path / "set" / WORK_FOLDER).is_dir()
    track_video(clip, tmp_path / "set", CONFIG)
    assert _files(tmp_path / "set") == _files(uninterrupted)


def test_a_run_begun_before_irises_were_found_looks_for_faces_anew(
    clip: Path, uninterrupted: Path, tmp_path: Path
) -> None:
    dst = tmp_path / "set"
    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, CONFIG, _interrupting("fit", 1))
    stages = dst / WORK_FOLDER / "stages.json"
    named = stages.read_text()
    assert "faces and irises from frame" in named
    stages.write_text(named.replace("faces and irises from frame", "faces from frame"))
    for path in (dst / WORK_FOLDER).glob("faces_*.npz"):
        with np.load(path) as whole:
            before = {name: whole[name] for name in whole.files if "iris" not in name}
        np.savez(path, **before)  # pyright: ignore[reportArgumentType]
    track_video(clip, dst, CONFIG)
    assert _files(dst) == _files(uninterrupted)


def test_a_second_process_is_kept_out_of_the_folder(clip: Path, tmp_path: Path) -> None:
    dst = tmp_path / "set"
    small = TrackConfig(image_size=48, key_frames=1, focal_px=500.0, max_frames=2)
    refused: list[str] = []

    def meanwhile(stage: str, done: int, total: int | None) -> None:
        if stage == "fit" and not refused:
            with pytest.raises(UserError, match="Another process is tracking") as told:
                track_video(clip, dst, small)
            refused.append(str(told.value))

    assert len(track_video(clip, dst, small, meanwhile)) == 2
    assert refused
    assert not list(dst.glob(".*")), "nothing of it stays"


def test_too_many_held_out_frames_are_told_before_images_and_cost_nothing(
    clip: Path, tmp_path: Path
) -> None:
    dst = tmp_path / "set"
    small = TrackConfig(image_size=48, key_frames=1, focal_px=500.0, max_frames=3)
    stages: list[str] = []
    with pytest.raises(UserError, match="3 of 3 tracked frames cannot be held out"):
        track_video(clip, dst, replace(small, test_frames=3), lambda *done: stages.append(done[0]))
    assert "pictures" not in stages
    faces = {path: path.stat().st_mtime_ns for path in (dst / WORK_FOLDER).glob("faces_*")}
    with pytest.raises(KeyboardInterrupt):
        track_video(clip, dst, replace(small, test_frames=1), _interrupting("pictures", 0))
    assert faces == {path: path.stat().st_mtime_ns for path in (dst / WORK_FOLDER).glob("faces_*")}
    assert faces
    assert len(track_video(clip, dst, replace(small, test_frames=1)).test) == 1


def test_damage_of_the_film_stands_in_the_report(clip: Path, tmp_path: Path) -> None:
    image = astronaut()[::2, ::2]
    frames = [np.roll(image, k, axis=1) for k in range(8)]
    cut = write_clip(tmp_path / "clip.avi", frames, "png", "rgb24")
    data = cut.read_bytes()
    place = data.index(b"\x89PNG", data.index(b"\x89PNG", data.index(b"\x89PNG") + 1) + 1)
    cut.write_bytes(data[:place] + bytes(64) + data[place + 64 :])
    notes = (source := FrameSource.open(cut)).notes
    read = len(list(source))
    assert 1 < read < 8
    track_video(cut, tmp_path / "set", TrackConfig(image_size=48, key_frames=1, focal_px=500.0))
    report = json.loads((tmp_path / "set/tracking.json").read_text())
    assert report["notes"] == notes
    assert notes
