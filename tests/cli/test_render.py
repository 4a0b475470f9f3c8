"""`rgbavatar render` on a small avatar: what is asked for is written, mistakes are told."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.cli import main as cli
from rgbavatar_ns.data import DatasetWriter, TrackedFrame
from rgbavatar_ns.data.png import encode_png_rgba, read_png_rgba
from rgbavatar_ns.export import front_camera, pictures, scenes
from tests.export.subject import avatar_of, camera_path, lively_theta

_SIZE, _FRAMES, _HELD_OUT = 32, 7, 3


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """The avatar's own dataset: pictures of itself."""
    return _write_dataset(tmp_path_factory.mktemp("data") / "own", seed=0)


def _write_dataset(folder: Path, seed: int) -> Path:
    avatar = avatar_of(seed)
    theta, camera = lively_theta(avatar, _FRAMES, seed), front_camera(avatar, _SIZE, _SIZE)
    layout = avatar.layout
    writer = DatasetWriter(folder, "makehuman", avatar.identity, layout, _SIZE, _SIZE)
    for index, image in enumerate(pictures(avatar, theta, camera, None)):
        writer.add(TrackedFrame(index, theta[index], camera, image))
    writer.finish(_HELD_OUT)
    return folder


def _render(*words: object) -> None:
    cli.main(["render", *map(str, words)])


def _film(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_held_out_frames_beside_truth_and_error(bundle, data, tmp_path, capsys):
    _render(bundle, tmp_path, "--data", data)
    film = _film(tmp_path / "comparison.mp4")
    assert len(film) == _HELD_OUT
    truth, avatar, error = np.split(film[0].astype(int), 3, axis=1)
    # The dataset shows the avatar itself, so that there is no error but the codec's.
    assert np.abs(truth - avatar).mean() < 6
    assert error.mean() < 24
    assert cv2.imread(str(tmp_path / "comparison.png")).shape == (3 * _SIZE, 3 * _SIZE, 3)
    assert "3 frames" in capsys.readouterr().out


def test_pngs_of_any_size_keep_the_alpha(bundle, data, tmp_path):
    words = ["--show", "performance", "--transparent", "--kind", "png", "--frames", 1, 3]
    _render(bundle, tmp_path, "--data", data, *words, "--width", 50, "--height", 40)
    files = sorted(tmp_path.rglob("*.png"))
    assert [str(f.relative_to(tmp_path)) for f in files] == [
        "performance/00000.png",
        "performance/00001.png",
    ]
    picture = read_png_rgba(files[0])
    assert picture.shape == (40, 50, 4)
    _render(bundle, tmp_path, "--data", data, *words[:-1], 2, "--width", 50)
    assert [f.name for f in tmp_path.rglob("*.png")] == ["00000.png"], "no frame of before"
    assert (picture[0, 0, 3], picture[..., 3].max()) == (0, 255)


def test_views_orbit_and_turntable(bundle, data, tmp_path):
    common = ["--data", data, "--width", 24, "--height", 24]
    _render(bundle, tmp_path, *common, "--show", "views", "--hold", 1, "--kind", "png")
    views = read_png_rgba(tmp_path / "views" / "00000.png")
    assert views.shape == (24, 4 * 24, 4)
    _render(bundle, tmp_path, *common, "--show", "orbit")
    assert len(_film(tmp_path / "orbit.mp4")) == _HELD_OUT
    _render(bundle, tmp_path, *common, "--show", "turntable", "--arc", 360)
    turn = _film(tmp_path / "turntable.gif")
    assert len(turn) == 72
    assert np.abs(turn[0].astype(int) - turn[36]).max() > 100, "front and back differ"
    assert np.abs(turn[0].astype(int) - turn[71]).mean() < 12, "the circle closes"
    _render(bundle, tmp_path, *common, "--show", "turntable", "--arc", 60)
    swing = _film(tmp_path / "turntable.gif")
    assert np.abs(swing[0].astype(int) - swing[36]).max() < 40, "to and fro passes the middle"
    assert np.abs(swing[18].astype(int) - swing[54]).max() > 60


def test_a_camera_path_sets_size_rate_and_length(bundle, data, tmp_path):
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.0, 0.0, 1.0])
    described = camera_path(pose.expand(5, 4, 4), render_height=20, render_width=30, fps=12)
    path = tmp_path / "path.json"
    path.write_text(json.dumps(described))
    words = ["--data", data, "--show", "camera-path", "--camera-path", path]
    _render(bundle, tmp_path, *words)
    film = _film(tmp_path / "camera-path.mp4")
    assert len(film) == 5
    assert film[0].shape == (20, 30, 3)
    with av.open(str(tmp_path / "camera-path.mp4")) as container:
        assert container.streams.video[0].average_rate == 12


def test_a_painted_texture_shows(bundle, data, tmp_path, refused):
    red = np.full((64, 64, 4), (255, 0, 0, 255), np.uint8)
    (tmp_path / "red.png").write_bytes(encode_png_rgba(red))
    words = ["--show", "performance", "--kind", "png", "--frames", 1, 2, "--texture"]
    _render(bundle, tmp_path, "--data", data, *words, tmp_path / "red.png")
    middle = read_png_rgba(tmp_path / "performance" / "00000.png")[_SIZE // 2, _SIZE // 2]
    assert middle[0] > 200
    assert max(middle[1:3]) < 60
    (tmp_path / "red.png").write_bytes(encode_png_rgba(red[1:]))
    assert "64 x 63 pixels" in refused(
        "render", bundle, tmp_path, "--data", data, *words, tmp_path / "red.png"
    )


def test_the_grid_of_bases(bundle, data, tmp_path):
    _render(bundle, tmp_path, "--data", data, "--show", "bases")
    # Base and four bases, each beside what it changes.
    assert cv2.imread(str(tmp_path / "bases.png")).shape == (2 * _SIZE, 4 * 2 * _SIZE, 3)


def test_another_person_drives_the_avatar_and_is_shown_beside(bundle, data, tmp_path, capsys):
    driver = _write_dataset(tmp_path / "driver", seed=1)
    words = ["--data", data, "--show", "performance", "--driver", driver, "--smooth", "--project"]
    _render(bundle, tmp_path, *words)
    film = _film(tmp_path / "performance.mp4")
    assert len(film) == _FRAMES
    assert film[0].shape == (_SIZE, 2 * _SIZE, 3)
    told = capsys.readouterr().out
    assert "left out" not in told
    still = ("--kind", "png", "--frames", 0, 1, "--frames-per-second", 50)
    _render(bundle, tmp_path, *words, *still)  # The rate counts for smoothing.
    _render(bundle, tmp_path, *words[:-1])
    beyond = r"beyond the film in \d of 7 pictures: .*\(\d\)"
    assert re.search(beyond, capsys.readouterr().out), "what is not held back is told"


def test_a_held_expression_stands_beside_the_drivers_picture_of_it(bundle, data, tmp_path):
    driver = _write_dataset(tmp_path / "driver", seed=1)
    words = ["--data", data, "--driver", driver, "--kind", "png", "--frames", 1, 6]
    _render(bundle, tmp_path / "all", *words)
    _render(bundle, tmp_path / "one", *words, "--hold", 2)
    played, held = (sorted((tmp_path / name).rglob("*.png")) for name in ("all", "one"))
    assert (len(played), len(held)) == (5, 1)
    assert np.array_equal(read_png_rgba(held[0]), read_png_rgba(played[2]))


def test_views_tell_what_of_them_is_beyond_the_film(bundle, data, tmp_path, capsys):
    driver = _write_dataset(tmp_path / "driver", seed=1)
    words = ["--data", data, "--driver", driver, "--relative", "off", "--pose", "absolute"]
    told = []
    for show in ("performance", "views"):
        _render(bundle, tmp_path, *words, "--show", show, "--kind", "png")
        line = re.search(
            r"beyond the film in \d+ of (\d+) (pictures|views): .*", capsys.readouterr().out
        )
        assert line is not None
        shown = (_FRAMES * 4, "views") if show == "views" else (_FRAMES, "pictures")
        assert (int(line[1]), line[2]) == shown
        told.append(dict(re.findall(r"(\S+) \((\d+)\)", line[0])))
    alone, views = told
    common = alone.keys() & views.keys() - {"turn"}  # The most frequent six are named.
    assert len(common) >= 4
    assert all(int(views[name]) == 4 * int(alone[name]) for name in common)
    assert len(list((tmp_path / "views").iterdir())) == _FRAMES, "with four views each"


def test_a_bundle_with_statistics_needs_no_dataset(bundle, data, tmp_path, refused):
    cli.main(["export", str(bundle), str(tmp_path / "me"), "--data", str(data)])
    words = ["--show", "views", "--kind", "png", "--width", 20, "--height", 20]
    _render(tmp_path / "me", tmp_path, *words)
    views = read_png_rgba(tmp_path / "views" / "00000.png")
    assert views.shape == (20, 80, 4)
    assert views[..., :3].std() > 20
    _render(tmp_path / "me", tmp_path, "--driver", data, "--frames", 0, 2)
    assert len(_film(tmp_path / "performance.mp4")) == 2
    assert "own dataset" in refused("render", tmp_path / "me", tmp_path)
    _render(tmp_path / "me", tmp_path, "--show", "orbit", "--width", 20, "--height", 20)
    assert len(_film(tmp_path / "orbit.mp4")) == 72, "of one face the camera's way is the film"
    words = ["--show", "performance", "--frames", 0, 2]
    assert "are those of a dataset" in refused("render", tmp_path / "me", tmp_path, *words)


def _rate(path: Path) -> float:
    with av.open(str(path)) as container:
        return float(container.streams.video[0].average_rate)


def test_films_keep_the_rate_of_the_performance(bundle, data, tmp_path):
    driver = _write_dataset(tmp_path / "driver", seed=1)
    for folder, rate in ((driver, 50.0), (Path(shutil.copytree(data, tmp_path / "own")), 12.5)):
        index = folder / "dataset.json"
        index.write_text(json.dumps(json.loads(index.read_text()) | {"frames_per_second": rate}))
    own = ["--data", tmp_path / "own", "--width", 24, "--height", 24]
    _render(bundle, tmp_path, *own[:2])
    assert _rate(tmp_path / "comparison.mp4") == 12.5
    _render(bundle, tmp_path, *own, "--show", "performance")
    assert _rate(tmp_path / "performance.mp4") == 12.5
    _render(bundle, tmp_path, *own, "--driver", driver)
    assert _rate(tmp_path / "performance.mp4") == 50
    _render(bundle, tmp_path, *own, "--show", "orbit", "--hold", 0)
    assert _rate(tmp_path / "orbit.mp4") == 25, "a held face has no rate of its own"
    _render(bundle, tmp_path, *own, "--show", "orbit", "--frames-per-second", 30)
    assert _rate(tmp_path / "orbit.mp4") == 30


def test_of_several_cameras_one_is_shown(bundle, data, tmp_path):
    folder = Path(shutil.copytree(data, tmp_path / "several"))
    index = json.loads((folder / "dataset.json").read_text())
    frames = [dict(f, camera_name="ab"[f["index"] % 2]) for f in index["frames"]]
    described = index | {"version": 2, "frames": frames}
    (folder / "dataset.json").write_text(json.dumps(described))
    words = ["--data", folder, "--show", "performance"]
    _render(bundle, tmp_path, *words)
    assert len(_film(tmp_path / "performance.mp4")) == 2, "frames 4 and 6 of 4 to 6"
    _render(bundle, tmp_path, *words, "--driver", folder)
    assert len(_film(tmp_path / "performance.mp4")) == 4


def test_what_a_driver_has_of_its_own_is_told(bundle, data, tmp_path, monkeypatch, capsys):
    driven_by = scenes.driven_by

    def mapped(*given):
        return replace(driven_by(*given), unmapped=("pout",), told="its expressions are fitted")

    monkeypatch.setattr(scenes, "driven_by", mapped)
    _render(bundle, tmp_path, "--data", data, "--driver", data, "--frames", 0, 2)
    told = capsys.readouterr().out
    assert "its expressions are fitted\nnot known to the avatar, left out: pout\n" in told


def test_mistakes_are_told(bundle, data, tmp_path, refused):
    assert "does not name its dataset" in refused("render", bundle, tmp_path)
    for words, told in (
        ("--show orbit --transparent", "--kind png"),
        ("--frames 5 9", "no frames 5 to 9"),
        ("--show views --hold 7", "no frame 7 to hold"),
        ("--show camera-path", "--camera-path"),
        ("--width 0", "--width is 0"),
        ("--kind gif", "--kind changes nothing of --show comparison"),
        ("--hold 0", "--hold changes nothing of --show comparison"),
        ("--transparent", "--transparent changes nothing of --show comparison"),
        ("--show bases --frames 1 2", "--frames changes nothing of --show bases"),
        ("--show views --arc 20", "--arc changes nothing of --show views"),
        ("--show orbit --gain 2", "take --show bases"),
        ("--show performance --smooth", "nobody drives the avatar"),
        ("--show bases --frames-per-second 9", "--frames-per-second changes nothing of --show ba"),
        ("--show camera-path --frames-per-second 9", "changes nothing of --show camera-path"),
        ("--show views --kind png --frames-per-second 9", "changes nothing of --kind png"),
        (
            "--show views --kind png --transparent --background 0 0 0",
            "--background changes nothing of --transparent",
        ),
        (
            "--show bases --transparent --background 0 0 0",
            "--background changes nothing of --transparent",
        ),
    ):
        assert told in refused("render", bundle, tmp_path, "--data", data, *words.split())


def test_a_driver_of_another_head_without_a_common_expression_is_refused(
    bundle, data, tmp_path, refused, flame_2020_pickle
):
    from rgbavatar_ns.head import HeadModel
    from rgbavatar_ns.head.flame import load_flame

    head = HeadModel(load_flame(flame_2020_pickle, num_identity=2, num_expressions=4, teeth=False))
    camera = front_camera(avatar_of(), _SIZE, _SIZE)
    driver = tmp_path / "driver"
    writer = DatasetWriter(driver, head.arrays, torch.zeros(2), head.layout, _SIZE, _SIZE)
    image = np.zeros((_SIZE, _SIZE, 4), np.uint8)
    writer.add(TrackedFrame(0, torch.zeros(head.layout.size), camera, image))
    writer.finish(0)
    words = ["--data", data, "--show", "performance", "--driver", driver]
    told = refused("render", bundle, tmp_path / "out", *words)
    assert "expression_0" in told
    assert "browDownLeft" in told
