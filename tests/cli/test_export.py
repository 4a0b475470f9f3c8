"""`rgbavatar export`: each format opens elsewhere, mistakes are told."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from plyfile import PlyData

from rgbavatar_ns import Avatar
from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.cli import main as cli
from rgbavatar_ns.cli.export import page_frames
from rgbavatar_ns.data import DatasetWriter, TrackedFrame, load_dataset
from rgbavatar_ns.data.png import encode_png_rgba, read_png_rgba
from rgbavatar_ns.export import calm_theta, front_camera
from tests.data.small_dataset import NUM_FRAMES, NUM_TEST, small_dataset
from tests.export.avatar_of_page import avatar_of_page
from tests.export.subject import avatar_of, lively_theta


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "own"
    small_dataset(folder, avatar_of().head)
    return folder


def _export(*words: object) -> None:
    cli.main(["export", *map(str, words)])


def test_a_bundle_gets_statistics_of_the_training_frames_and_passes_them_on(bundle, data, tmp_path):
    _export(bundle, tmp_path / "first", "--data", data)
    _export(tmp_path / "first", tmp_path / "second", "--no-head-inside")
    seen = load_avatar(tmp_path / "second").training_statistics
    assert seen is not None
    dataset = load_dataset(data)
    theta = dataset.theta[list(dataset.train)]
    assert seen.num_frames == NUM_FRAMES - NUM_TEST
    assert torch.allclose(seen.theta_max, theta.amax(0))
    first, second = (Avatar.load(place) for place in (bundle, tmp_path / "second"))
    with torch.no_grad():
        assert torch.allclose(seen.psi_mean, first.weights(theta).mean(0))
        one, other = first.gaussians(theta[:1]), second.gaussians(theta[:1])
    assert torch.equal(one.means, other.means)


def test_a_ply_of_a_frame_and_of_the_head_at_rest(bundle, data, tmp_path):
    _export(bundle, tmp_path / "rest.ply", "--format", "ply")
    _export(bundle, tmp_path / "frame.ply", "--format", "ply", "--data", data, "--frame", 2)
    avatar, dataset = Avatar.load(bundle), load_dataset(data)
    for name, theta in (
        ("rest", torch.zeros(1, avatar.layout.size)),
        ("frame", dataset.theta[2:3]),
    ):
        vertex = PlyData.read(str(tmp_path / f"{name}.ply"))["vertex"]
        with torch.no_grad():
            expected = avatar.gaussians(theta).means[0].numpy()
        np.testing.assert_allclose(np.stack([vertex[a] for a in "xyz"], 1), expected)


@pytest.mark.parametrize(("format", "suffix"), [("ply", "ply"), ("gltf", "glb")])
def test_a_sequence_has_a_file_for_each_frame(bundle, data, tmp_path, format, suffix):
    words = ["--format", format, "--data", data, "--frames", 2, 4]
    _export(bundle, tmp_path / "film", *words)
    names = sorted(path.name for path in (tmp_path / "film").iterdir())
    assert names == [f"00002.{suffix}", f"00003.{suffix}"]


def test_colours_go_out_are_painted_and_come_back(bundle, tmp_path, capsys):
    _export(bundle, tmp_path / "me.png", "--format", "texture")
    assert "me_wires.png" in capsys.readouterr().out
    picture = read_png_rgba(tmp_path / "me.png")
    assert read_png_rgba(tmp_path / "me_wires.png").shape == picture.shape
    _export(bundle, tmp_path / "same", "--texture", tmp_path / "me.png")
    _export(bundle, tmp_path / "plain")
    picture[..., :3] = (255, 0, 0)
    (tmp_path / "red.png").write_bytes(encode_png_rgba(picture))
    _export(bundle, tmp_path / "red", "--texture", tmp_path / "red.png")
    plain, same, red = (Avatar.load(tmp_path / name) for name in ("plain", "same", "red"))
    colors = [avatar.blendshapes.color_feature for avatar in (plain, same, red)]
    assert torch.equal(colors[0], colors[1])
    middle = (0.5 + 0.28209479 * colors[2]).median(0).values
    assert torch.allclose(middle, torch.tensor([1.0, 0.0, 0.0]), atol=0.05)


def _frames(page: Path) -> int:
    """Of a page's performance."""
    return len(avatar_of_page(page)[1]["theta"])


def test_a_page_with_and_without_a_performance(bundle, data, tmp_path):
    _export(bundle, tmp_path / "still.html", "--format", "web")
    _export(bundle, tmp_path / "film.html", "--format", "web", "--data", data, "--title", "Me")
    _export(bundle, tmp_path / "calm.html", "--format", "web", "--data", data, "--no-performance")
    assert "<title>Me</title>" in (tmp_path / "film.html").read_text()
    counts = [_frames(tmp_path / f"{name}.html") for name in ("still", "film", "calm")]
    assert counts == [0, NUM_FRAMES, 0]


def test_another_persons_film_drives_and_says_nothing_of_the_avatars(
    bundle, data, tmp_path, capsys
):
    _export(bundle, tmp_path / "me", "--data", data)  # It knows its film from now on.
    own, mine = load_avatar(tmp_path / "me").training_statistics, Avatar.load(bundle)
    theta = lively_theta(mine, 3, seed=5)

    def film(name: str, identity: torch.Tensor) -> Path:
        head, camera = mine.head, front_camera(mine, 16, 12)
        # Nearer, so that what is beside the face is beyond the picture.
        camera = replace(camera, focal_px=3 * camera.focal_px)
        writer = DatasetWriter(tmp_path / name, head.arrays, identity, head.layout, 16, 12)
        for index, row in enumerate(theta):
            writer.add(TrackedFrame(index, row, camera, np.zeros((12, 16, 4), np.uint8)))
        writer.finish(1)
        return tmp_path / name

    identities = {"mine": mine.identity + 3e-6, "other": mine.identity + 0.3}
    for name, identity in identities.items():
        films = film(name, identity.detach())
        _export(tmp_path / "me", tmp_path / f"{name}_bundle", "--data", films)
        seen = load_avatar(tmp_path / f"{name}_bundle").training_statistics
        assert own is not None
        assert seen is not None
        assert torch.equal(seen.theta_max, own.theta_max)
        assert seen.num_frames == own.num_frames
        capsys.readouterr()
        _export(tmp_path / "me", tmp_path / f"{name}.html", "--data", films)
        is_cut = "beyond every picture's edge" in capsys.readouterr().out
        assert is_cut == (name == "mine")
        arrays = avatar_of_page(tmp_path / f"{name}.html")[1]
        np.testing.assert_allclose(arrays["theta"], theta, atol=2e-3)
        calm = calm_theta(own, theta[0]).numpy()
        np.testing.assert_allclose(arrays["neutral_theta"][:, 0], calm, atol=1e-6)


def test_a_performance_that_nobody_chose_is_of_thirty_seconds(bundle, data, tmp_path):
    words = [bundle, tmp_path / "a.html", "--format", "web", "--data", data]
    _export(*words, "--frames-per-second", 0.1)
    assert _frames(tmp_path / "a.html") == 3


def test_of_several_cameras_the_first_ones_film_is_played(data):
    dataset = load_dataset(data)
    names = tuple("ab"[place % 2] for place in range(len(dataset)))
    several = replace(dataset, camera_names=names)
    assert page_frames(several, None, 25.0) == tuple(range(0, len(dataset), 2))
    assert page_frames(several, (1, 3), 25.0) == (1, 2)
    assert page_frames(None, None, 25.0) == ()


def test_a_page_is_told_who_may_speak_to_it(bundle, tmp_path):
    _export(
        *[bundle, tmp_path / "a.html", "--format", "web", "--origins", "https://example.org"],
        *["http://localhost:8000", "--servers", "wss://drive.example.org:8443"],
    )
    page = (tmp_path / "a.html").read_text()
    assert '"origins": ["https://example.org", "http://localhost:8000"]' in page
    policy = re.search(r'content="(default-src[^"]*)"', page)
    assert policy
    assert policy[1].endswith(" wss://localhost:* wss://drive.example.org:8443")


def test_a_module_is_a_folder_for_a_site(bundle, data, tmp_path, capsys):
    _export(bundle, tmp_path / "site", "--format", "web-module", "--data", data)
    names = {path.name for path in (tmp_path / "site").iterdir()}
    examples = {"example.html", "example-mediapipe.html", "example-three.html"}
    assert names == {"avatar.rgba", "rgbavatar.js", "rgbavatar.d.ts"} | examples
    assert "example.html" in capsys.readouterr().out


def test_the_destinations_ending_says_what_is_written(bundle, tmp_path):
    names = ("a.ply", "a.compressed.ply", "a.glb", "a.HTML", "a.png", "a")
    for name in names:
        _export(bundle, tmp_path / name)
    begins = [(tmp_path / name).read_bytes()[:9] for name in names[:-1]]
    assert [text[:3] for text in begins[:2]] == [b"ply"] * 2
    compressed, plain = ((tmp_path / name).stat().st_size for name in names[1::-1])
    assert compressed < plain / 2
    assert begins[2][:4] == b"glTF"
    assert begins[3] == b"<!doctype"
    assert begins[4][1:4] == b"PNG"
    Avatar.load(tmp_path / "a")


@pytest.mark.parametrize(
    "name", ["me.gltf", "me.SPLAT", "me.ksplat", "me.zip", "me.obj", "me.usdz"]
)
def test_the_ending_of_what_is_not_written_is_told(name, bundle, tmp_path, refused):
    told = refused("export", bundle, tmp_path / name)
    assert f"asks for a {Path(name).suffix.lower()} file, which is not written" in told
    assert ".compressed.ply, .ply, .glb" in " ".join(told.split())
    assert list(tmp_path.iterdir()) == []
    _export(bundle, tmp_path / name, "--format", "bundle")
    Avatar.load(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "format"),
    [("me.glb", "ply"), ("me.HTML", "ply"), ("me.png", "sog"), ("me.ply", "bundle")],
)
def test_an_ending_that_contradicts_the_format_is_told(name, format, bundle, tmp_path, refused):
    told = refused("export", bundle, tmp_path / name, "--format", format)
    assert f"{name} asks for --format " in told
    assert f"--format {format} is given" in told
    assert list(tmp_path.iterdir()) == []


def test_both_kinds_of_ply_have_its_ending(bundle, tmp_path):
    _export(bundle, tmp_path / "me.ply", "--format", "compressed-ply")
    assert (tmp_path / "me.ply").read_bytes()[:3] == b"ply"


def test_a_name_with_a_point_is_a_bundles_too(bundle, tmp_path):
    _export(bundle, tmp_path / "me.v2")
    Avatar.load(tmp_path / "me.v2")


def test_a_film_is_played_at_its_own_rate(bundle, tmp_path):
    film = small_dataset(tmp_path / "film", avatar_of().head)
    index = tmp_path / "film" / "dataset.json"
    index.write_text(json.dumps(json.loads(index.read_text()) | {"frames_per_second": 30}))
    words = ("--data", tmp_path / "film")
    _export(bundle, tmp_path / "own.html", *words)
    _export(bundle, tmp_path / "slow.html", *words, "--frames-per-second", 10)
    rates = [
        avatar_of_page(tmp_path / name)[0]["frames_per_second"]
        for name in ("own.html", "slow.html")
    ]
    assert rates == [30, 10]
    assert film.playback_rate == 25, "of a dataset that does not say"


def test_a_picture_to_paint_on_is_not_written_over(bundle, tmp_path, refused):
    _export(bundle, tmp_path / "me.png")
    before = (tmp_path / "me.png").read_bytes()
    assert "may have been painted on" in refused("export", bundle, tmp_path / "me.png")
    assert (tmp_path / "me.png").read_bytes() == before


def test_the_runs_own_data_is_the_default(bundle, data, tmp_path, capsys):
    run = Path(shutil.copytree(bundle, tmp_path / "run"))
    manager = {"dataparser": {"data": None}, "data": [str(data)]}
    described = {"data": None, "pipeline": {"datamanager": manager}}
    (run / "config.yml").write_text(yaml.safe_dump(described))
    _export(run, tmp_path / "film.html", "--format", "web", "--frames", 1, 4)
    assert _frames(tmp_path / "film.html") == 3
    manager["data"] = [str(tmp_path / "gone")]
    (run / "config.yml").write_text(yaml.safe_dump(described))
    _export(run, tmp_path / "still.html", "--format", "web")
    assert "without the frames of the run's own data" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("format", "told"),
    [
        ("web", "such as avatar.html."),
        ("ply", "such as avatar.ply."),
        ("texture", "such as avatar.png."),
    ],
)
def test_the_folder_one_stands_in_is_no_destination_of_a_file(
    format, told, bundle, tmp_path, refused, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rgbavatar_ns.avatar.loading.load_avatar", None)  # no work before
    assert told in refused("export", bundle, ".", "--format", format)
    assert list(tmp_path.iterdir()) == []


def test_mistakes_are_told(bundle, data, tmp_path, refused):
    framed = [bundle, tmp_path / "a.ply", "--format", "ply", "--data", data]
    for words, told in (
        ([tmp_path / "none", tmp_path / "out"], "There is no"),
        ([bundle, tmp_path / "a.ply", "--format", "ply", "--frame", 1], "--data"),
        ([bundle, tmp_path / "out", "--format", "gltf", "--frames", 0, 2], "--data"),
        ([bundle, tmp_path / "out", "--texture", data / "dataset.json"], "not a PNG"),
        ([*framed, "--frame", 1, "--frames", 0, 2], "both --frame and --frames"),
        ([bundle, tmp_path / "a.html", "--format", "web", "--frames", 0, 2], "--data"),
        ([bundle, tmp_path / "a.html", "--format", "web", "--frames-per-second", "nan"], "is nan"),
        ([*framed, "--frame", 99], "no frames"),
        ([bundle, tmp_path / "a.html", "--format", "web", "--origins", "null"], "is no origin"),
        ([bundle, tmp_path / "a.html", "--format", "web", "--origins", "https://a.b/c"], "a path"),
        (
            [bundle, tmp_path / "a.html", "--format", "web", "--servers", "ws://a; x"],
            "is no server",
        ),
        ([bundle, data], "not an avatar bundle"),
        ([bundle, tmp_path / "b.ply", "--no-head-inside"], "--no-head-inside changes nothing of"),
        ([bundle, tmp_path / "b.html", "--frame", 1], "--frame changes nothing of --format web."),
        ([bundle, tmp_path / "b.png", "--frames", 0, 1], "--frames changes nothing of"),
        ([bundle, tmp_path / "b", "--frames-per-second", 25], "--frames-per-second changes"),
        ([bundle, tmp_path / "b", "--no-performance"], "or take --format web or --format web-m"),
        (
            [bundle, tmp_path / "b", "--format", "web-module", "--title", "Me"],
            "--title changes nothing of --format web-module",
        ),
    ):
        assert told in refused("export", *words)
