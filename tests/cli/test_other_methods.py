"""What `rgbavatar export`, `render` and `drive` do with avatars of other methods."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from plyfile import PlyData

from rgbavatar_ns.avatar.loading import load_avatar
from rgbavatar_ns.avatar.methods.gaussianblendshapes import (
    GaussianBlendshapes,
    GaussianBlendshapesConfig,
)
from rgbavatar_ns.cli.main import main
from rgbavatar_ns.data import DatasetWriter, TrackedFrame, load_dataset
from rgbavatar_ns.experiments.avatar_size import avatar_size
from rgbavatar_ns.experiments.cell_pictures import read_pictures, write_pictures
from rgbavatar_ns.experiments.reenactment import reenactment_scores
from rgbavatar_ns.experiments.rendering_speed import frames_per_second
from rgbavatar_ns.experiments.streamed import write_streamed
from rgbavatar_ns.export import front_camera, pictures
from rgbavatar_ns.head import HeadModel
from tests.export.subject import avatar_of, lively_theta

SIZE, FRAMES, HELD_OUT = 32, 6, 3
CONFIG = GaussianBlendshapesConfig(num_points=400, initial_opacity=0.9)


@pytest.fixture(scope="module")
def rival(tmp_path_factory) -> Path:
    """A bundle of another method."""
    own = avatar_of()
    avatar = GaussianBlendshapes(HeadModel.embedded(), own.identity, CONFIG)
    with torch.no_grad():
        avatar.face.color.copy_(1.5 * torch.sin(40 * avatar.face.position)[:, None])
    folder = tmp_path_factory.mktemp("avatar") / "rival"
    avatar.save(folder)
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory, rival) -> Path:
    """Its dataset: pictures of itself."""
    folder, avatar = tmp_path_factory.mktemp("data") / "own", load_avatar(rival)
    theta, camera = lively_theta(avatar, FRAMES), front_camera(avatar, SIZE, SIZE)
    writer = DatasetWriter(folder, "makehuman", avatar.identity, avatar.layout, SIZE, SIZE)
    for index, image in enumerate(pictures(avatar, theta, camera, None)):
        writer.add(TrackedFrame(index, theta[index], camera, image))
    writer.finish(HELD_OUT)
    return folder


def run(*words: object) -> None:
    main([str(word) for word in words])


def length(film: Path) -> int:
    with av.open(str(film)) as container:
        return len(list(container.decode(video=0)))


def test_a_bundle_goes_out_with_what_it_saw(rival, data, tmp_path, capsys):
    run("export", rival, tmp_path / "out", "--data", data)
    assert "GaussianBlendshapes.load(" in capsys.readouterr().out
    seen = load_avatar(tmp_path / "out").training_statistics
    assert seen is not None
    assert seen.num_frames == FRAMES - HELD_OUT
    first, second = (load_avatar(place) for place in (rival, tmp_path / "out"))
    assert isinstance(second, GaussianBlendshapes)
    theta = lively_theta(first, 1, seed=2)
    assert torch.equal(first.gaussians(theta).means, second.gaussians(theta).means)
    # Seen at rest without the dataset, then driven.
    still = ("--show", "views", "--kind", "png", "--width", 20, "--height", 20)
    run("render", tmp_path / "out", tmp_path, *still)
    views = cv2.imread(str(tmp_path / "views" / "00000.png"))
    assert views.shape == (20, 80, 3)
    assert views.std() > 20
    run("render", tmp_path / "out", tmp_path, "--driver", data, "--frames", 0, 2)
    assert length(tmp_path / "performance.mp4") == 2


def test_gaussians_of_a_frame_and_of_a_sequence(rival, data, tmp_path):
    framed = ("--format", "ply", "--data", data)
    run("export", rival, tmp_path / "frame.ply", *framed, "--frame", 2)
    vertex = PlyData.read(str(tmp_path / "frame.ply"))["vertex"]
    theta = load_dataset(data).theta[2:3]
    with torch.no_grad():
        wanted = load_avatar(rival).gaussians(theta)
    place = np.stack([vertex[axis] for axis in "xyz"], 1)
    np.testing.assert_allclose(place, wanted.means[0].numpy(), atol=1e-6)
    color = 0.5 + 0.28209479 * np.stack([vertex[f"f_dc_{k}"] for k in range(3)], 1)
    np.testing.assert_allclose(color, wanted.colors[0].numpy(), atol=1e-5)
    run("export", rival, tmp_path / "all", "--format", "gltf", "--data", data, "--frames", 1, 4)
    assert sorted(path.name for path in (tmp_path / "all").iterdir()) == [
        f"{place:05d}.glb" for place in (1, 2, 3)
    ]


def test_films_beside_what_was_held_out(rival, data, tmp_path):
    run("render", rival, tmp_path, "--data", data)
    assert length(tmp_path / "comparison.mp4") == HELD_OUT
    truth, avatar, error = np.split(cv2.imread(str(tmp_path / "comparison.png")).astype(int), 3)
    assert truth.std() > 20
    # The dataset shows the avatar itself.
    assert np.abs(truth - avatar).max() <= 1
    assert error.max() <= 4


def test_what_needs_bases_and_the_uv_map_is_refused_and_says_what_can_be_had(
    rival, data, tmp_path, refused
):
    out = tmp_path / "out"
    for words, told in (
        (("export", rival, out, "--format", "web"), "--format web needs"),
        (("export", rival, out, "--format", "web-module"), "--format web-module needs"),
        (("export", rival, out, "--format", "texture"), "--format texture needs"),
        (("export", rival, out, "--texture", data / "dataset.json"), "--texture"),
        (("render", rival, out, "--data", data, "--show", "bases"), "--show bases"),
        (("render", rival, out, "--data", data, "--texture", data / "x.png"), "--texture"),
        (("drive", rival, "--data", data, "--source", data, "--show", "page"), "--show page"),
    ):
        said = " ".join(refused(*words).split())
        assert told in said
        assert "gaussianblendshapes-style" in said
        assert "rgbavatar render" in said
    assert not out.exists()


def test_a_performance_drives_its_film(rival, data, tmp_path):
    film = tmp_path / "film.mp4"
    run("drive", rival, "--data", data, "--source", data, "--out", film)
    assert length(film) >= FRAMES


def test_a_cell_of_an_experiment_takes_it(rival, data, tmp_path):
    avatar, dataset = load_avatar(rival), load_dataset(data)
    size = avatar_size(avatar)
    assert size["gaussians"] == 400 + 2 * 40
    assert size["megabytes"] == sum(p.numel() for p in avatar.parameters()) * 4 / 1e6
    assert frames_per_second(avatar, dataset) > 0
    write_pictures(avatar, dataset, tmp_path)
    assert len(read_pictures(tmp_path)) == HELD_OUT
    # Its own pictures, in 8 bits.
    assert write_streamed(avatar, dataset, tmp_path, {})["l1_streamed"] < 1 / 255
    values, missing = reenactment_scores(avatar, dataset, dataset, None, None)
    assert values == {}
    assert missing.keys() == {"aed", "apd", "csim"}
