"""The user's own mattes are taken as they are; ours do not flicker and drag nothing along."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from rgbavatar_ns.cli.track import run
from rgbavatar_ns.data.check.report import quick_check
from rgbavatar_ns.data.native.dataset import load_native
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.tracking import TrackConfig, track_video
from rgbavatar_ns.tracking.image.crop import SquareCrop
from rgbavatar_ns.tracking.image.steady_matte import CoarseMatte, head_motion, steadied
from rgbavatar_ns.tracking.input.mattes import UserMattes
from rgbavatar_ns.tracking.input.video import FrameSource

from .clips import astronaut, gradient_images, write_clip

CONFIG = TrackConfig(image_size=96, key_frames=1, focal_px=500.0)


def _folder(path: Path, images: dict[str, np.ndarray]) -> Path:
    path.mkdir()
    for name, image in images.items():
        cv2.imwrite(str(path / name), image)
    return path


def _levels(mattes: UserMattes, frames: set[int], width: int, height: int) -> dict[int, int]:
    return {
        index: int(matte.max()) for index, matte in mattes.levels(frozenset(frames), width, height)
    }


def test_mattes_go_to_images_by_name(tmp_path: Path) -> None:
    names = ("b", "a", "c")
    frames = _folder(tmp_path / "f", {f"{n}.png": np.zeros((4, 6, 3), np.uint8) for n in names})
    masks = {f"{n}.png": np.full((4, 6), 50 * k, np.uint8) for k, n in enumerate(names)}
    mattes = UserMattes.open(_folder(tmp_path / "m", masks), FrameSource.open(frames))
    assert _levels(mattes, {0, 1, 2}, 6, 4) == {0: 50, 1: 0, 2: 100}


def test_mattes_go_to_videos_by_number(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "clip.mkv", gradient_images(11, 4, 6), "ffv1", "yuv444p")
    masks = {f"matte_{k + 1}.png": np.full((4, 6), 20 * k, np.uint8) for k in range(11)}
    mattes = UserMattes.open(_folder(tmp_path / "m", masks), FrameSource.open(clip))
    mattes.require_count(11, limited=False)
    assert _levels(mattes, {1, 10}, 6, 4) == {1: 20, 10: 200}


def test_a_mattes_alpha_counts_before_its_grey(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "clip.mkv", gradient_images(1, 4, 6), "ffv1", "yuv444p")
    rgba = np.zeros((4, 6, 4), np.uint8)
    rgba[:2, :, 3] = 90
    mattes = UserMattes.open(_folder(tmp_path / "m", {"0.png": rgba}), FrameSource.open(clip))
    ((_, matte),) = mattes.levels(frozenset({0}), 6, 4)
    np.testing.assert_array_equal(matte, rgba[..., 3])


def test_a_mask_video_is_read_in_step(tmp_path: Path) -> None:
    masks = [np.full((16, 16, 3), 30 * k, np.uint8) for k in range(6)]
    clip = write_clip(tmp_path / "clip.mkv", gradient_images(6, 16, 16), "ffv1")
    mask = write_clip(tmp_path / "mask.mkv", masks, "ffv1", "yuv444p")
    mattes = UserMattes.open(mask, FrameSource.open(clip))
    levels = _levels(mattes, {2, 5}, 16, 16)
    assert levels == pytest.approx({2: 60, 5: 150}, abs=2)


def test_missing_surplus_and_misfitting_mattes_are_told(tmp_path: Path) -> None:
    clip = FrameSource.open(write_clip(tmp_path / "clip.mkv", gradient_images(4), "ffv1"))
    with pytest.raises(UserError, match="no mattes at"):
        UserMattes.open(tmp_path / "absent", clip)
    small = {f"{k}.png": np.zeros((8, 8), np.uint8) for k in range(3)}
    mattes = UserMattes.open(_folder(tmp_path / "small", small), clip)
    with pytest.raises(UserError, match="holds 3 mattes, the video has 4 frames"):
        mattes.require_count(4, limited=False)
    with pytest.raises(UserError, match="holds 3 mattes, the video has 2 frames"):
        mattes.require_count(2, limited=False)
    mattes.require_count(2, limited=True)
    with pytest.raises(UserError, match="8 x 8 pixels, the video 64 x 48"):
        list(mattes.levels(frozenset({0}), 64, 48))
    video = UserMattes.open(write_clip(tmp_path / "mask.mkv", gradient_images(2), "ffv1"), clip)
    with pytest.raises(UserError, match="ends before frame 3"):
        list(video.levels(frozenset({1, 3}), 64, 48))
    images = {f"{k}.png": np.zeros((8, 8, 3), np.uint8) for k in range(3)}
    folder = FrameSource.open(_folder(tmp_path / "images", images))
    with pytest.raises(UserError, match="no matte named 2"):
        UserMattes.open(_folder(tmp_path / "two", dict(list(small.items())[:2])), folder)


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_mattes_with_somebody_in_a_few_frames_are_not_dark_all_over(
    tmp_path: Path, kind: str
) -> None:
    empty = np.zeros((16, 16, 3), np.uint8)
    person = empty.copy()
    person[4:12, 4:12] = 255
    masks = [person if 24 <= k < 45 else empty for k in range(160)]
    if kind == "folder":
        path = _folder(tmp_path / "m", {f"{k:03}.png": mask for k, mask in enumerate(masks)})
    else:
        path = write_clip(tmp_path / "m.mp4", masks, "libx264")  # one group of pictures
    clip = FrameSource.open(write_clip(tmp_path / "f.mkv", gradient_images(1, 16, 16), "ffv1"))
    mattes = UserMattes.open(path, clip)
    for enough in (None, 25):
        mattes.require_somebody(enough)
    with pytest.raises(UserError, match=r"dark all over: the lightest place has \d of 255"):
        mattes.require_somebody(24)


def test_whether_mattes_are_dark_is_asked_of_what_is_read_as_the_matte(tmp_path: Path) -> None:
    clip = FrameSource.open(write_clip(tmp_path / "f.mkv", gradient_images(2), "ffv1"))
    for colour, alpha in ((0, 255), (255, 0)):
        image = np.full((48, 64, 4), colour, np.uint8)
        image[..., 3] = 0
        image[8:40, 8:56, 3] = alpha
        path = tmp_path / f"{colour}.webm"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libvpx-vp9", rate=25)
            stream.height, stream.width, stream.pix_fmt = 48, 64, "yuva420p"
            for _ in range(2):
                frame = av.VideoFrame.from_ndarray(image, format="rgba")
                container.mux(stream.encode(frame.reformat(format="yuva420p")))
            container.mux(stream.encode())
        mattes = UserMattes.open(path, clip)
        assert _levels(mattes, {0, 1}, 64, 48) == pytest.approx({0: alpha, 1: alpha}, abs=3)
        if alpha:
            mattes.require_somebody(None)
        else:
            with pytest.raises(UserError, match="dark all over"):
                mattes.require_somebody(None)


def _disc(size: int, x: float) -> np.ndarray:
    rows, columns = np.mgrid[0:size, 0:size] + 0.5
    return np.clip(30 - np.hypot(rows - 64, columns - x) + 0.5, 0, 1).astype(np.float32)


def _picture(mask: np.ndarray, noise: np.ndarray) -> np.ndarray:
    stripes = 110 + 40 * np.sin(np.arange(128) / 3)[None, :, None]
    picture = mask[..., None] * (200, 150, 120) + (1 - mask[..., None]) * stripes
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def test_flicker_sinks_where_the_picture_does_not_change() -> None:
    random = np.random.default_rng(0)
    disc = _disc(128, 64)
    coarse, seen = [], []
    for _ in range(9):
        flicker = cv2.GaussianBlur(random.normal(size=(128, 128)), (0, 0), 3) * 2
        coarse.append(np.clip(disc + flicker * (disc > 0.01), 0, 1).astype(np.float32))
        picture = _picture(disc, random.normal(size=(128, 128, 1)) * 2)
        seen.append(CoarseMatte.of(picture, coarse[-1]))
    still = np.eye(2, 3)
    steady = [
        steadied(coarse[k], seen[k], [(seen[n], still) for n in range(k - 2, k + 3) if n != k])
        for k in range(2, 7)
    ]
    before, after = (np.abs(np.diff(mattes, axis=0)).mean() for mattes in (coarse[2:7], steady))
    assert after < 0.5 * before


def test_what_moves_against_the_head_leaves_no_ghost() -> None:
    # The disc jumps by its own width between frames while the head is said to stand still.
    coarse = [_disc(128, x) for x in (30, 64, 98)]
    seen = [CoarseMatte.of(_picture(mask, np.zeros(1)), mask) for mask in coarse]
    still = np.eye(2, 3)
    steady = steadied(coarse[1], seen[1], [(seen[0], still), (seen[2], still)])
    gone = (coarse[0] > 0.9) & (coarse[1] < 0.1)
    assert steady[gone].mean() < 0.03
    assert steady[coarse[1] > 0.9].min() > 0.9


def test_a_matte_that_moves_with_the_head_stays_sharp() -> None:
    coarse = [_disc(128, x) for x in (56, 64, 72)]
    pictures = [(60 + 140 * mask)[..., None].repeat(3, 2).astype(np.uint8) for mask in coarse]
    seen = [CoarseMatte.of(picture, mask) for picture, mask in zip(pictures, coarse)]
    points = np.random.default_rng(1).uniform(40, 90, (20, 2))
    moves = [head_motion(points + np.array([8 * (k - 1), 0]), points) for k in (0, 2)]
    # Its own matte is wrong at the top; both neighbours, moved along, know better.
    wrong = coarse[1].copy()
    wrong[:44] = 0
    now = CoarseMatte(wrong, seen[1].thumbnail)
    steady = steadied(wrong, now, [(seen[0], moves[0]), (seen[2], moves[1])])
    # The mean of all three; in the open and inside the disc that is two thirds.
    np.testing.assert_allclose(steady[40, 58:70], 2 / 3, atol=0.02)
    np.testing.assert_allclose(steady[46:], coarse[1][46:], atol=0.1)


def test_head_motion_recovers_a_similarity() -> None:
    points = np.random.default_rng(2).normal(size=(30, 2))
    turn = 1.1 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    motion = head_motion(points, points @ turn.T + np.array([5, -2]))
    np.testing.assert_allclose(motion, np.concatenate([turn, [[5], [-2]]], axis=1), atol=1e-12)


def test_a_users_matte_and_an_alpha_channel_end_up_in_the_dataset(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    image = astronaut()[::2, ::2, ::-1]
    own = np.zeros(image.shape[:2], np.uint8)
    own[:, :100] = 255
    frames, masks, alphas = (
        _folder(tmp_path / name, {f"{k}.png": picture for k in range(2)})
        for name, picture in (("f", image), ("m", own), ("a", np.dstack([image, own])))
    )
    by_mask = track_video(frames, tmp_path / "x", replace(CONFIG, mattes=masks))
    by_alpha = track_video(alphas, tmp_path / "y", CONFIG)
    for dataset in (by_mask, by_alpha):
        alpha = dataset.read_image(1)[..., 3]
        assert alpha[48, :20].min() == 255
        assert alpha[:, -20:].max() == 0
    solid = [dataset.read_image(0)[..., 3] > 127 for dataset in (by_mask, by_alpha)]
    np.testing.assert_array_equal(*solid)
    short = _folder(tmp_path / "s", {"0.png": own})
    with pytest.raises(UserError, match="no matte named 1"):
        track_video(frames, tmp_path / "z", replace(CONFIG, mattes=short))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda own: 0 * own, r"mattes in .* dark all over: the lightest place has 0 of 255"),
        (lambda own: own // 255, r"mattes in .* dark all over: the lightest place has 1 of 255"),
        (lambda own: 255 - own, r"mattes in .*m leave the face out: they hold \d% of it"),
        (
            lambda own: np.roll(own, 130, 1),
            r"mattes in .*m leave the face out: they hold \d% of it",
        ),
    ],
)
def test_mattes_of_something_else_are_told_before_anything_is_fitted(
    tmp_path: Path, wrong: Callable[[np.ndarray], np.ndarray], told: str
) -> None:
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    image = astronaut()[::2, ::2, ::-1]
    own = np.zeros(image.shape[:2], np.uint8)
    own[:, 40:150] = 255
    given = wrong(own)
    frames, masks = (
        _folder(tmp_path / name, {f"{k}.png": picture for k in range(2)})
        for name, picture in (("f", image), ("m", given))
    )
    stages: list[str] = []
    with pytest.raises(UserError, match=told) as error:
        track_video(
            frames,
            tmp_path / "x",
            replace(CONFIG, mattes=masks),
            lambda stage, *rest: stages.append(stage),
        )
    assert "255" in str(error.value) or "inverted" in str(error.value)
    assert set(stages) <= {"faces", "outlines"}
    assert not list((tmp_path / "x").glob("*")), "nothing is left behind"
    if given[0, 0] == 255:
        # Of an alpha channel too.
        alphas = _folder(tmp_path / "a", {f"{k}.png": np.dstack([image, given]) for k in range(2)})
        with pytest.raises(UserError, match="alpha channel leave the face out"):
            track_video(alphas, tmp_path / "y", CONFIG)


def test_a_dataset_that_training_refuses_is_not_recommended_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Twenty columns of the face are this person, but too little to train on; thirty are enough."""
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    image = astronaut()[::2, ::2, ::-1]
    narrow, wide = np.zeros((2, *image.shape[:2]), np.uint8)
    narrow[:, 88:108] = 255
    wide[:, 85:115] = 255
    frames = _folder(tmp_path / "f", {f"{k}.png": image for k in range(2)})
    for name, matte in (("narrow", narrow), ("wide", wide)):
        masks = _folder(tmp_path / name, {f"{k}.png": matte for k in range(2)})
        run((frames, tmp_path / f"of_{name}"), replace(CONFIG, mattes=masks))
        printed = " ".join(capsys.readouterr().out.split())
        refused = quick_check(load_native(tmp_path / f"of_{name}"))
        told = json.loads((tmp_path / f"of_{name}" / "tracking.json").read_text())
        assert told["refused"] == [problem.to_json() for problem in refused]
        assert bool(refused) == (name == "narrow")
        assert ("ns-train" in printed) == (not refused)
        for problem in refused:
            assert told["verdict"].startswith("look at it")
            assert problem.cause.rstrip(".") in told["verdict"]
            assert problem.cause in printed
            assert problem.remedy in printed


def test_who_has_no_body_in_the_given_mattes_has_none_to_follow(tmp_path: Path) -> None:
    """The picture shows shoulders, of which segmentation knows; the mattes end at the chin."""
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    image = astronaut()[::2, ::2, ::-1]
    head = np.zeros(image.shape[:2], np.uint8)
    head[:80] = 255
    frames, masks, alphas = (
        _folder(tmp_path / name, {f"{k}.png": picture for k in range(2)})
        for name, picture in (("f", image), ("m", head), ("a", np.dstack([image, head])))
    )
    seen_cm2 = {}
    for name, source, mattes in (
        ("found", frames, None),
        ("m", frames, masks),
        ("a", alphas, None),
    ):
        track_video(source, tmp_path / "out" / name, replace(CONFIG, mattes=mattes))
        told = json.loads((tmp_path / "out" / name / "tracking.json").read_text())
        seen_cm2[name] = told["body"]["seen_cm2"]
    assert seen_cm2["found"] > 100
    assert seen_cm2["m"] == seen_cm2["a"] == 0


def test_a_mask_video_of_varying_rate_is_counted_by_its_frames_and_not_by_its_length(
    tmp_path: Path,
) -> None:
    times = [33 * k + (33 * (k // 2)) for k in range(30)]
    film = write_clip(tmp_path / "f.mkv", gradient_images(14), "ffv1", times_ms=times[:14])
    mask = write_clip(tmp_path / "m.mkv", gradient_images(14), "ffv1", times_ms=times[:14])
    mattes = UserMattes.open(mask, FrameSource.open(film))
    mattes.require_count(14, limited=False)
    assert len(_levels(mattes, set(range(14)), 64, 48)) == 14
    short = write_clip(tmp_path / "s.mkv", gradient_images(9), "ffv1", times_ms=times[:9])
    with pytest.raises(UserError, match="ends before frame 13"):
        _levels(UserMattes.open(short, FrameSource.open(film)), set(range(14)), 64, 48)


@pytest.mark.parametrize("suffix", ["mkv", "mp4"])
@pytest.mark.parametrize("surplus", [-1, 0, 1])
def test_a_mask_video_with_a_frame_more_or_less_is_told_before_mattes_shift(
    tmp_path: Path, suffix: str, surplus: int
) -> None:
    images = gradient_images(1) * 100
    film = FrameSource.open(write_clip(tmp_path / "film.mkv", images))
    mask = write_clip(tmp_path / f"mask.{suffix}", gradient_images(1) * (100 + surplus))
    mattes = UserMattes.open(mask, film)
    if surplus:
        with pytest.raises(UserError, match=rf"holds {100 + surplus} mattes, the video has 100"):
            mattes.require_count(100, limited=False)
        mattes.require_count(99, limited=True)
    else:
        mattes.require_count(100, limited=False)


def test_mattes_of_the_first_images_are_enough_where_no_more_are_read(tmp_path: Path) -> None:
    black = np.zeros((4, 6, 3), np.uint8)
    frames = _folder(tmp_path / "f", {f"{k}.png": black for k in range(3)})
    mask = _folder(tmp_path / "m", {"0.png": black[..., 0] + 7})
    mattes = UserMattes.open(mask, FrameSource.open(frames, max_frames=1))
    mattes.require_count(1, limited=True)
    assert _levels(mattes, {0}, 6, 4) == {0: 7}


@pytest.mark.parametrize("size", [85, 256, 400])
def test_what_an_alpha_channel_hides_does_not_colour_the_edge(size: int) -> None:
    rows, columns = np.mgrid[:256, :256]
    disc = np.hypot(rows - 128, columns - 128) < 90
    alpha = (255 * disc).astype(np.uint8)
    image = np.where(disc[..., None], np.uint8(200), np.uint8(0)).repeat(3, -1)
    color, level = SquareCrop(0, 0, 256, size).matted(image, alpha)
    assert (np.abs(color.astype(int) - 200).max(-1) <= 2)[level > 8 / 255].all()
    assert level.mean() == pytest.approx(disc.mean(), abs=0.005)


def test_round_corners_are_no_matte(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    alpha = np.full((200, 200, 1), 255, np.uint8)
    alpha[:2, :2] = 0
    image = np.concatenate([astronaut()[::2, ::2, ::-1], alpha], -1)
    screenshots = _folder(tmp_path / "f", {f"{k}.png": image for k in range(2)})
    track_video(screenshots, tmp_path / "x", CONFIG)
    assert json.loads((tmp_path / "x/tracking.json").read_text())["matte"] == "selfie segmentation"


def test_a_matte_in_a_few_frames_is_told_and_not_used(tmp_path: Path) -> None:
    pytest.importorskip("mediapipe", reason="the tracker's optional extra is not installed")
    image = astronaut()[::2, ::2, ::-1]
    alpha = np.full((200, 200, 1), 255, np.uint8)
    cut_out = np.concatenate([image, alpha], -1)
    cut_out[:50, :, 3] = 0
    frames = _folder(tmp_path / "f", {"0.png": image, "1.png": cut_out, "2.png": image})
    track_video(frames, tmp_path / "x", CONFIG)
    report = json.loads((tmp_path / "x/tracking.json").read_text())
    assert report["matte"] == "selfie segmentation"
    assert report["notes"] == ["1 of 3 frames have an alpha channel; so it is not used"]
