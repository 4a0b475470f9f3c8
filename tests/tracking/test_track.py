import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from rgbavatar_ns.drawing.compositing import unfilmed_pixels
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking import TrackConfig, track_video
from rgbavatar_ns.tracking.face.detector import load_mediapipe
from rgbavatar_ns.tracking.fit.camera import require_possible_focal

from .clips import REAL_CLIPS, astronaut, gradient_images, write_clip

pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
CLIP = REAL_CLIPS / "grid_id2.mpg"
needs_clip = pytest.mark.skipif(not CLIP.exists(), reason=f"the clip {CLIP.name} is not here")


@pytest.fixture(scope="module")
def portrait(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """A written clip: the portrait drifts, two frames in the middle show no face."""
    image, frames = astronaut(), []
    blank = [3, 4]
    for number in range(9):
        shifted = np.roll(image, 2 * number, axis=1)
        frames.append(np.full_like(image, 90) if number in blank else shifted)
    path = tmp_path_factory.mktemp("portrait") / "portrait.mp4"
    return write_clip(path, frames), blank


def test_a_written_clip_becomes_a_dataset_without_its_faceless_frames(
    portrait: tuple[Path, list[int]], tmp_path: Path
) -> None:
    clip, blank = portrait
    calls: list[tuple[str, int, int | None]] = []
    config = TrackConfig(image_size=128, key_frames=3, focal_px=500.0)
    dataset = track_video(clip, tmp_path / "set", config, lambda *done: calls.append(done))

    report = json.loads((tmp_path / "set" / "tracking.json").read_text())
    assert report["frames_read"] == 9
    assert set(blank) <= set(report["rejected"]["no face"])
    assert not set(dataset.frame_index) & set(report["rejected"]["no face"])
    assert report["frames_tracked"] == len(dataset) >= 5
    assert report["reprojection_error_share"] < 0.015
    assert report["iris_error_eye_widths"] < 0.1
    assert report["film"]["frames"] == len(dataset)
    assert f"length ({len(dataset)} of 500 frames)" in report["film"]["lacks"]
    assert report["film"]["face_height_px"] == report["face_height_px"]
    assert (tmp_path / "set" / "overlay.png").stat().st_size > 10_000
    assert len(dataset.test) == len(dataset) // 5
    stages = list(dict.fromkeys(call[0] for call in calls))
    expected = ["faces", "outlines", "fit", "body", "place", "background", "pictures", "report"]
    assert stages == expected
    assert report["background"] in ("still", "covered", "too short")
    for stage in stages:
        done = [call[1] for call in calls if call[0] == stage]
        assert done == sorted(done)
        assert done[-1] == [call[2] for call in calls if call[0] == stage][-1]

    image = dataset.read_image(0)
    assert image.shape == (128, 128, 4)
    assert image[64, 64, 3] == 255, "the face is solid"
    assert image[2, 2, 3] == 0, "the background is gone"
    assert (image[..., 3] > 0).mean() < 0.7


def test_every_frame_is_told_of_and_matrices_keep_to_one_thread(
    portrait: tuple[Path, list[int]], tmp_path: Path
) -> None:
    """Else a long film would seem to stand, and a busy machine would wait for idle threads."""
    told: dict[str, set[int]] = {}
    threads: set[int] = set()

    def watch(stage: str, done: int, _total: int | None) -> None:
        told.setdefault(stage, set()).add(done)
        pools = threadpool_info()
        threads.update(pool["num_threads"] for pool in pools if pool["user_api"] == "blas")

    config = TrackConfig(image_size=64, key_frames=2, focal_px=500.0)
    with threadpool_limits(2, user_api="blas"):  # as at a user's, where the suite keeps to one
        dataset = track_video(portrait[0], tmp_path / "set", config, watch)

    for stage in ("fit", "body", "place", "pictures"):
        assert told[stage] == set(range(min(told[stage]), len(dataset) + 1)), stage
    read = max(told["outlines"] - {9}) + 1  # up to the last key frame
    assert told["outlines"] == {*range(read), 9}
    assert threads == {1}


def test_the_body_is_left_out_only_when_asked_for(
    portrait: tuple[Path, list[int]], tmp_path: Path
) -> None:
    shares = []
    for head_only in (True, False):
        config = TrackConfig(
            image_size=96, key_frames=1, max_frames=1, focal_px=500.0, head_only=head_only
        )
        dataset = track_video(portrait[0], tmp_path / str(head_only), config)
        assert dataset.arrays.has_torso != head_only
        shares.append(dataset.read_image(0)[-12:-6, :, 3].mean() / 255)
        assert dataset.read_image(0)[-1, :, 3].max() < 20, "it fades out at the bottom"
    assert shares[0] < 0.05
    assert shares[1] > 0.3


@pytest.mark.parametrize("focal_px", [1.0, 40.0, 3.0e4])
def test_a_focal_length_of_no_camera_is_told_before_anything_is_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, focal_px: float
) -> None:
    """The film is 320 x 160: what sees 152 degrees of it, or half of one, is no lens."""
    film = write_clip(tmp_path / "film.mp4", gradient_images(3, 160, 320))
    monkeypatch.delattr("rgbavatar_ns.tracking.track.find_faces")
    with pytest.raises(UserError, match=r"80 to 16000 pixels.*Leave --focal-px out") as error:
        track_video(film, tmp_path / "x", TrackConfig(focal_px=focal_px))
    assert f"{focal_px:g} pixels" in str(error.value)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("focal_px", [None, 90.0, 110.0, 380.0, 1.5e4])
def test_focal_lengths_of_cameras_are_taken(focal_px: float | None) -> None:
    require_possible_focal(focal_px, 320, 160)
    require_possible_focal(focal_px, 160, 320)


def test_missing_mediapipe_is_told_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import importlib

    real = importlib.import_module

    def refuse(name: str, *rest: Any) -> Any:
        if name == "mediapipe":
            raise ModuleNotFoundError("No module named 'mediapipe'")
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", refuse)
    clip = write_clip(tmp_path / "grey.mp4", gradient_images(2, 96, 96))
    with pytest.raises(UserError, match=r"--no-deps mediapipe==0\.10\.21 protobuf==4\.25"):
        track_video(clip, tmp_path / "set")


def test_a_protobuf_that_mediapipe_fails_beside_is_told_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import google.protobuf

    monkeypatch.setattr(google.protobuf, "__version__", "3.20.3")
    with pytest.raises(UserError, match=r"beside protobuf 3\.20\.3.*protobuf==4\.25"):
        load_mediapipe()


@pytest.mark.parametrize("head_only", [True, False], ids=["head", "body"])
def test_what_the_frame_cuts_off_is_marked_as_not_filmed(tmp_path: Path, head_only: bool) -> None:
    """The portrait ends above the chin: the crop reaches beyond, where the chin would be."""
    height = 160
    clip = write_clip(tmp_path / "cut.mp4", [astronaut()[:height]] * 2)
    config = TrackConfig(image_size=96, focal_px=500.0, head_only=head_only)
    dataset = track_video(clip, tmp_path / "set", config)
    report = json.loads((tmp_path / "set" / "tracking.json").read_text())
    image = dataset.read_image(0)
    unfilmed = unfilmed_pixels(image)
    crop = report["crop"]
    last = int((height - crop["top"]) * len(image) / crop["side"])
    assert last < len(image) - 4, "the crop reaches beyond"
    assert not unfilmed[: last - 1].any()
    assert image[last - 6, :, 3].max() > 200, "the face goes on to the edge"
    assert not image[last:, :, 3].any()
    chin = [one.mean() for one in np.nonzero(unfilmed)]
    if not head_only:
        assert unfilmed[last:].all()
    else:
        assert last < chin[0] < last + 12
        assert unfilmed[last:].mean() < 0.5, "what is below the neck is cut off anyway"
    assert report["unfilmed_share"] == pytest.approx(unfilmed.mean(), rel=0.1)
    assert json.loads((tmp_path / "set/dataset.json").read_text())["version"] == 3


def test_a_face_in_one_frame_only_gives_one_frame_and_a_warning(tmp_path: Path) -> None:
    image = astronaut()
    frames = [np.full_like(image, 90) for _ in range(4)]
    frames[2] = image
    clip = write_clip(tmp_path / "once.mp4", frames)
    dataset = track_video(clip, tmp_path / "set", TrackConfig(image_size=64, focal_px=500.0))
    assert dataset.frame_index == (2,)
    assert (len(dataset.train), len(dataset.test)) == (1, 0)
    report = json.loads((tmp_path / "set" / "tracking.json").read_text())
    assert report["rejected"]["no face"] == [0, 1, 3]
    assert report["verdict"].startswith("look at it")
    assert report["segments"] == [{"first_frame": 2, "last_frame": 2, "clip": 0}]


def test_another_face_beside_the_followed_one_is_reported(tmp_path: Path) -> None:
    portrait = astronaut()[::2, ::2]
    alone = np.full((200, 400, 3), 128, np.uint8)
    alone[:, :200] = portrait
    both = alone.copy()
    both[:, 200:] = portrait[:, ::-1]
    clip = write_clip(tmp_path / "two.mp4", [alone, alone, both, both])
    config = TrackConfig(image_size=64, key_frames=1, focal_px=500.0)
    dataset = track_video(clip, tmp_path / "set", config)
    report = json.loads((tmp_path / "set" / "tracking.json").read_text())
    assert report["other_faces"] == [2, 3]
    assert "another face is seen in 2 frames" in report["verdict"]
    assert len(report["segments"]) == 1
    across = dataset.theta[:, dataset.layout.slice("translation").start]
    assert across.std() < 0.02


@needs_clip
def test_ten_frames_of_the_real_clip_are_tracked_closely(tmp_path: Path) -> None:
    config = TrackConfig(max_frames=10, key_frames=4)
    dataset = track_video(CLIP, tmp_path / "set", config)
    report = json.loads((tmp_path / "set" / "tracking.json").read_text())
    assert len(dataset) == 10
    assert report["reprojection_error_share"] < 0.01
    assert report["mesh_reprojection_error_share"] < 0.015
    assert dataset.theta[:, dataset.layout.slice("rotation")].abs().max() < 0.4
