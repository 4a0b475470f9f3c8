import json
import os
import shlex
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import pytest

from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.cli import demo
from rgbavatar_ns.cli.main import main
from rgbavatar_ns.export.run_data import dataset_folder
from rgbavatar_ns.files import write_json

OPTIONS = ["--frames", "12", "--image-size", "48", "--steps", "12"]


def test_the_command_is_installed():
    (command,) = entry_points(group="console_scripts", name="rgbavatar")
    assert command.load() is main


@pytest.mark.slow
def test_demo_goes_from_nothing_to_a_film_and_the_second_time_only_tells(tmp_path, capsys):
    # As of a film "my head.mp4".
    tmp_path = tmp_path / "my head"
    main(["demo", "--output", str(tmp_path), *OPTIONS])
    told = capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    for name in ("psnr", "ssim", "train_seconds", "images_per_second", "total_seconds"):
        assert summary[name] > 0, name
    assert summary["held_out_frames"] == 3
    assert summary["total_seconds"] >= summary["train_seconds"]
    with av.open(summary["video"]) as film:
        frames = [frame for frame in film.decode(video=0)]
    assert [(f.width, f.height) for f in frames] == [(3 * 48, 48)] * 3
    assert cv2.imread(summary["picture"]).shape[0] == 3 * 48
    assert "ns-viewer" in told
    assert str(summary["picture"]) in told.replace("\n", "")
    # The folder is an experiment's as ns-train makes them, which other commands take.
    assert (tmp_path / demo.TINY / "latest" / "config.yml").is_file()
    assert load_avatar(tmp_path).num_gaussians == load_avatar(Path(summary["run"])).num_gaussians
    assert dataset_folder(tmp_path) == Path(summary["data"])
    (command,) = (line for line in told.splitlines() if line.startswith("web page"))
    _, *arguments = shlex.split(command.removeprefix("web page"))
    main(arguments)
    assert (tmp_path / "me.html").is_file()

    main(["demo", "--output", str(tmp_path), *OPTIONS])
    assert capsys.readouterr().out.count("done before") == 4
    again = json.loads((tmp_path / "summary.json").read_text())
    assert again["psnr"] == summary["psnr"]
    assert again["total_seconds"] < summary["total_seconds"]


@pytest.mark.parametrize(
    ("options", "film_px", "method", "size"),
    [
        ([], 512, "rgbavatar-quick", None),
        ([], 288, "rgbavatar-tiny", None),
        (["--tiny"], 512, "rgbavatar-tiny", 256),
        (["--tiny", "--image-size", "480"], 512, "rgbavatar-tiny", 480),
    ],
)
def test_a_video_is_made_sharp_where_it_shows_enough_and_small_when_asked_for(
    tmp_path, monkeypatch, options, film_px, method, size
):
    asked = {}

    def track(video, destination, image_size, head_only):
        asked["size"] = image_size
        return {"data": str(destination), "image_size": image_size or film_px}

    def train(method, data, run_folder, seed, options):
        asked["method"], asked["options"] = method, options
        return {"train_seconds": 1.0, "images_per_second": 1.0}

    scores = {"psnr": 30.0, "psnr_head": 30.0, "ssim": 0.9}
    shown = {"frames": 1, "video": "film", "picture": "picture"}
    monkeypatch.setattr(demo, "_track", track)
    monkeypatch.setattr(demo.commands, "train", train)
    monkeypatch.setattr(demo.commands, "evaluate", lambda *given: scores)
    monkeypatch.setattr(demo, "_film", lambda *given: shown)
    clip = tmp_path / "me.mp4"
    clip.touch()
    main(["demo", "--video", str(clip), "--output", str(tmp_path / "out"), *options])
    assert (asked["method"], asked["size"]) == (method, size)
    assert "--pipeline.model.refine-tracking" in asked["options"]
    assert "--learning-rate-steps" not in asked["options"]
    main(
        ["demo", "--video", str(clip), "--output", str(tmp_path / "out"), *options, "--steps", "9"]
    )
    named = shlex.join(asked["options"])
    assert "--max-num-iterations 9" in named
    assert "--learning-rate-steps 9" in named, "the rates fall over them"


def test_another_film_of_the_same_name_does_not_replace_an_avatars_data(
    tmp_path, monkeypatch, refused
):
    """Cameras count their films, so that two people's may both be IMG_0001."""
    clips = [tmp_path / place / "IMG_0001.mp4" for place in ("a", "b")]
    for clip in clips:
        clip.parent.mkdir()
        clip.touch()
    done = {"key": "", "seconds": 1.0}
    film = str(clips[0].resolve())
    output = tmp_path / "outputs" / "IMG_0001"
    stage = done | {"result": {"data": "data", "image_size": 256, "films": [film]}}
    write_json(output / "stages.json", {"track": stage})
    monkeypatch.chdir(tmp_path)
    told = refused("demo", "--video", clips[1])
    assert f"has the avatar of another film, {film}" in told
    assert "--output" in told


@pytest.mark.parametrize(
    ("stage", "options", "who"),
    [
        ("demo subject", ["--video", "me.mp4"], "the demo subject"),
        ("track", [], "another film, you.mp4"),
    ],
)
def test_a_video_and_the_demo_subject_do_not_replace_one_another(
    tmp_path, monkeypatch, refused, stage, options, who
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "me.mp4").touch()
    result = {"data": "data", "films": ["you.mp4"]}
    write_json(tmp_path / "x/stages.json", {stage: {"key": "", "seconds": 1.0, "result": result}})
    assert f"has the avatar of {who}." in refused("demo", "--output", "x", *options)


def test_without_nerfstudios_commands_nothing_is_tracked(tmp_path, monkeypatch, refused):
    (tmp_path / "me.mp4").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo.commands, "find_program", lambda name: None)
    monkeypatch.setattr(demo, "_track", lambda *given: pytest.fail("it was tracked"))
    assert "There is no ns-train in the environment" in refused("demo", "--video", "me.mp4")
    assert shlex.split(demo._command("ns-viewer", "--help")) == ["ns-viewer", "--help"]


@pytest.fixture
def stages(monkeypatch):
    """Stands in for what takes long: the videos that were tracked, the methods trained."""
    done = SimpleNamespace(tracked=[], trained=[])
    film = SimpleNamespace(width=512)

    def track(video, *given, **named):
        done.tracked.append(video)
        return film

    monkeypatch.setattr("rgbavatar_ns.tracking.track_video", track)
    facts = {"train_seconds": 1.0, "images_per_second": 1.0}

    def train(method, data, run_folder, *given):
        done.trained.append(method)
        assert not run_folder.exists()  # where there is a complete run nothing would be trained
        run_folder.mkdir(parents=True)
        return facts

    scores = {"psnr": 30.0, "psnr_head": 30.0, "ssim": 0.9}
    monkeypatch.setattr(demo.commands, "train", train)
    monkeypatch.setattr(demo.commands, "evaluate", lambda *given: scores)
    shown = {"frames": 1, "video": "film", "picture": "picture"}
    monkeypatch.setattr(demo, "_film", lambda *given: shown)
    return done


def test_an_avatars_data_is_not_replaced_by_the_same_film_tracked_otherwise(
    tmp_path, monkeypatch, refused, stages
):
    """`make demo VIDEO=me.mp4`, then a tiny one: the first one's frames were gone."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "me.mp4").touch()
    main(["demo", "--video", "me.mp4"])
    told = refused("demo", "--video", "me.mp4", "--tiny")
    assert "has an avatar of this film" in told
    assert "--output" in told
    assert "the head alone" in refused("demo", "--video", "me.mp4", "--head-only")
    main(["demo", "--video", "me.mp4", "--steps", "9"])  # on the same data
    main(["demo", "--video", "me.mp4", "--tiny", "--output", "outputs/me-tiny"])
    main(["demo", "--video", "me.mp4", "--tiny", "--fresh"])
    assert stages.trained == ["rgbavatar-quick"] * 2 + ["rgbavatar-tiny"] * 2
    main(["demo", "--video", "me.mp4", "--tiny", "--fresh"])
    assert stages.trained[4:] == ["rgbavatar-tiny"]


def test_an_image_that_is_replaced_in_a_folder_is_tracked_anew(tmp_path, monkeypatch, stages):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "me").mkdir()
    image = tmp_path / "me" / "0.png"
    image.write_bytes(b"one")
    for _ in range(2):
        main(["demo", "--video", "me"])
    assert len(stages.tracked) == 1
    image.write_bytes(b"another")
    main(["demo", "--video", "me"])
    assert len(stages.tracked) == 2


@pytest.mark.parametrize("made_anew", [True, False])
def test_a_run_of_other_frames_is_not_gone_on_with(tmp_path, monkeypatch, made_anew):
    """As after `--fresh` that was interrupted while it tracked: the settings are the same."""
    data, run = tmp_path / "data", tmp_path / "rgbavatar-tiny/key"
    for path in (data / "dataset.json", run / "config.yml"):
        path.parent.mkdir(parents=True)
        path.touch()
    os.utime(data / "dataset.json", (0, 2000 if made_anew else 1000))
    os.utime(run / "config.yml", (0, 1500))
    kept = []

    def train(method, data, run_folder, *given):
        kept.append(run_folder.exists())
        return {"train_seconds": 1.0, "images_per_second": 1.0}

    monkeypatch.setattr(demo.commands, "train", train)
    given = (data, tmp_path, "key", "rgbavatar-tiny", None, 0)
    demo._train(*given, refine_tracking=True, anew=False)
    assert kept == [not made_anew]


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (["--video", "me.mp4", "--frames", "20"], "--frames changes nothing of a --video."),
        (["--head-only"], "--head-only changes nothing without a --video."),
    ],
)
def test_options_of_the_other_kind_are_refused(tmp_path, monkeypatch, refused, options, what):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "me.mp4").touch()
    assert what in refused("demo", *options)
    assert [path.name for path in tmp_path.iterdir()] == ["me.mp4"]
