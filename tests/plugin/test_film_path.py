"""Cameras of paths that nerfstudio makes show the moments of the film that they pass."""

import pytest
import torch
from nerfstudio.cameras.camera_paths import get_interpolated_camera_path
from nerfstudio.cameras.cameras import Cameras

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.film_path import FilmCameras, FilmMoment, FilmPath
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline

FRAMES = 9
TRAIN = (0, 1, 2, 3, 7)
TEST = (4, 5, 8)


def still(count: int) -> Cameras:
    pose = torch.eye(4)[:3].expand(count, 3, 4)
    return Cameras(pose, fx=100.0, fy=100.0, cx=16.0, cy=16.0, width=32, height=32)


def moving(places_m: list[float]) -> Cameras:
    cameras = still(len(places_m))
    cameras.camera_to_worlds = cameras.camera_to_worlds.clone()
    cameras.camera_to_worlds[:, 0, 3] = torch.tensor(places_m)
    return cameras


def walked(cameras: Cameras, positions: tuple[int, ...], steps: int, order: bool = False):
    """The moments of a path through these cameras, as nerfstudio draws it."""
    film = FilmPath(FRAMES, TRAIN)
    path = get_interpolated_camera_path(FilmCameras.of(cameras, positions, film), steps, order)
    return [film.moment(path[i : i + 1]) for i in range(path.size)]


@pytest.mark.parametrize("order", [False, True])
def test_still_cameras_go_from_frame_to_frame(order: bool):
    # Written by hand: nerfstudio's pairs of frames, each with both ends.
    assert walked(still(3), TEST, 3, order) == [
        FilmMoment(4, 5, 0.0),
        FilmMoment(4, 5, 0.5),
        FilmMoment(4, 5, 1.0),
        FilmMoment(5, 8, 0.0),
        FilmMoment(5, 8, 0.5),
        FilmMoment(5, 8, 1.0),
    ]


def test_one_step_shows_each_frame_but_the_last():
    assert [moment.nearest for moment in walked(still(5), TRAIN, 1)] == [0, 1, 2, 3]


def test_ordered_poses_bring_their_frames_along():
    places_m = [0.0, 3.0, 1.0, 4.0, 2.0]
    moments = walked(moving(places_m), TRAIN, 2, order=True)
    assert [m.nearest for m in moments[::2]] == [0, 2, 7, 1]
    assert [m.nearest for m in moments[1::2]] == [2, 7, 1, 3]
    unordered = walked(moving(places_m), TRAIN, 2)
    assert [m.nearest for m in unordered[::2]] == [0, 1, 2, 3]


def test_intrinsics_and_path_are_what_they_were():
    plain = moving([0.0, 1.0, 2.0])
    plain.fx = torch.tensor([[100.0], [110.0], [120.0]])
    film = FilmCameras.of(plain, TEST, FilmPath(FRAMES, TRAIN))
    assert torch.equal(film.get_intrinsics_matrices(), plain.get_intrinsics_matrices())
    own, theirs = (get_interpolated_camera_path(c, 4, True) for c in (film, plain))
    assert torch.equal(own.camera_to_worlds, theirs.camera_to_worlds)
    assert torch.equal(own.fx, theirs.fx)
    assert type(own.fx) is torch.Tensor


def test_slices_and_copies_lay_no_path():
    film = FilmPath(FRAMES, TRAIN)
    cameras = FilmCameras.of(still(3), TEST, film)
    for part in (cameras[0:2], cameras.to("cpu")):
        get_interpolated_camera_path(part, 2, False)
    assert film.moment(still(1)).nearest == 0


def test_without_path_or_time_the_film_plays_frame_by_frame():
    film = FilmPath(FRAMES, TRAIN)
    shown = [film.moment(still(1)).nearest for _ in range(FRAMES + 2)]
    assert shown == [*range(FRAMES), 0, 1]


def test_a_time_is_a_share_of_the_film():
    film = FilmPath(FRAMES, TRAIN)
    camera = still(1)
    for time, frame in ((0.0, 0), (0.5, 4), (1.0, 8), (1.7, 8), (-1.0, 0)):
        camera.times = torch.tensor([[time]])
        assert film.moment(camera) == FilmMoment(frame, frame, 0.0)


def test_a_named_training_frame_is_held():
    film = FilmPath(FRAMES, TRAIN)
    path = get_interpolated_camera_path(FilmCameras.of(still(3), TEST, film), 2, False)
    path.metadata = {"cam_idx": 4}
    assert {film.moment(path[i : i + 1]).nearest for i in range(path.size)} == {7}
    path.metadata = {"cam_idx": 5}
    with pytest.raises(UserError, match=r"--camera-idx is 5, .* 5 training frames.*0 to 4"):
        film.moment(path[0:1])


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_frames_for_a_path_are_told(count: int):
    cameras = FilmCameras.of(still(3)[:count], TEST[:count], FilmPath(FRAMES, TRAIN))
    with pytest.raises(UserError, match=f"has {count}.*--pose-source"):
        get_interpolated_camera_path(cameras, 2, False)


def test_pictures_along_a_path_are_those_of_theta_between(pipeline: RGBAvatarPipeline):
    data = pipeline.datamanager
    path = get_interpolated_camera_path(data.eval_dataset.cameras, 3, False)
    pictures = [
        pipeline.model.get_outputs_for_camera(path[i : i + 1])["rgb"] for i in range(path.size)
    ]
    first, second = data.dataparser.tracked.test[:2]
    theta = pipeline.model.frame_theta
    middle = pipeline.model.avatar.layout.between(theta[first], theta[second], 0.5)
    for picture, driven in zip(pictures, (theta[first], middle, theta[second])):
        drawn = pipeline.model.avatar.render(
            driven[None], data.dataparser.tracked.cameras.select([first])
        )
        assert torch.allclose(picture, drawn.image[0].clamp(0, 1), atol=1e-5)
    assert not torch.allclose(pictures[0], pictures[2])
