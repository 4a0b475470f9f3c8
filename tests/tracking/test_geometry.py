import numpy as np
import pytest

from rgbavatar_ns.tracking.fit.camera import StillCamera
from rgbavatar_ns.tracking.image.crop import SquareCrop, steady_crop
from rgbavatar_ns.tracking.image.head_mask import HeadMask, neck_ring
from rgbavatar_ns.tracking.image.matting import foreground_color


def test_projection_worked_by_hand() -> None:
    # 2 m away, 10 cm to the subject's left and 5 cm up: right of and above the centre.
    camera = StillCamera(400.0, (100.0, 80.0), 2.0)
    np.testing.assert_allclose(camera.project(np.array([[0.1, 0.05, 0.0]])), [[120.0, 70.0]])
    np.testing.assert_allclose(camera.project(np.array([[0.1, 0.05, 1.0]])), [[140.0, 60.0]])
    in_camera = camera.world_to_camera @ [0.1, 0.05, 1.0, 1.0]
    np.testing.assert_allclose(in_camera, [0.1, -0.05, 1.0, 1.0])
    assert (camera.px_per_m(0.0), camera.px_per_m(1.0)) == (200.0, 400.0)


def test_projection_derivative_equals_central_differences() -> None:
    camera = StillCamera(300.0, (50.0, 60.0), 1.5)
    points = np.random.default_rng(0).normal(size=(7, 3)) * 0.1
    derivative = camera.image_slope(points)
    for axis in range(3):
        shift = np.eye(3)[axis] * 1e-6
        slope = (camera.project(points + shift) - camera.project(points - shift)) / 2e-6
        np.testing.assert_allclose(derivative[..., axis], slope, atol=1e-5)


def test_cropped_camera_sees_cropped_points() -> None:
    camera = StillCamera(300.0, (50.0, 60.0), 1.5)
    crop = SquareCrop(left=-12, top=7, side=80, size=256)
    points = np.random.default_rng(1).normal(size=(5, 3)) * 0.1
    pinhole = crop.pinhole(camera)
    center = tuple(pinhole.principal_point_px[0].tolist())
    seen = StillCamera(pinhole.focal_px[0, 0].item(), center, 1.5)
    np.testing.assert_allclose(seen.project(points), crop.points(camera.project(points)), rtol=1e-5)


def test_crop_holds_every_landmark_and_stays_inside_where_it_fits() -> None:
    low, high = (90.0, 60.0), (150.0, 140.0)
    points = np.random.default_rng(2).uniform(low, high, (3, 478, 2))
    points[:, 0], points[:, 1] = low, high
    points[:, 10], points[:, 152] = (120.0, 60.0), (120.0, 140.0)
    crop = steady_crop(points, 320, 240, 128)
    assert crop.left >= 0
    assert crop.top >= 0
    assert crop.left + crop.side <= 320
    assert crop.top + crop.side <= 240
    inside = crop.points(np.array([low, high]))
    assert inside.min() > 0
    assert inside.max() < 128


@pytest.mark.parametrize(("face_px", "size"), [(50, 256), (200, 256), (230, 448), (400, 512)])
def test_without_a_size_a_crop_keeps_the_films_pixels_within_bounds(face_px: int, size: int):
    """Of a head that keeps still, 1.95 faces high: 256 where the film has under 400 pixels."""
    low, high = np.array([2000.0 - face_px / 4, 2000]), np.array([2000 + face_px / 4, 2000])
    points = np.broadcast_to((low + high) / 2, (1, 478, 2)).copy()
    points[:, 0], points[:, 1] = low, high
    points[:, 10] = 2000, 2000 - face_px / 2
    points[:, 152] = 2000, 2000 + face_px / 2
    crop = steady_crop(points, 4000, 4000, None)
    assert crop.side == pytest.approx(1.95 * face_px, abs=1)
    assert crop.size == size


def test_crop_beyond_the_frame_repeats_the_border_and_says_so() -> None:
    crop = SquareCrop(left=-4, top=0, side=16, size=16)
    image = np.arange(12 * 16 * 3, dtype=np.uint8).reshape(12, 16, 3)
    cut, inside = crop.apply(image), crop.inside(16, 12)
    np.testing.assert_array_equal(cut[:12, 4:], image[:, :12])
    np.testing.assert_array_equal(cut[:12, 0], image[:, 0])
    assert inside[:12, 4:].min() == 1
    assert inside[12:].max() == 0
    assert inside[:, :4].max() == 0


def test_a_pixel_that_shows_the_frame_in_part_is_not_inside() -> None:
    """Enlarged or made smaller, and by no whole factor: what is said to be inside lies there."""
    for size in (5, 7, 16, 23, 40):
        crop = SquareCrop(left=-3, top=2, side=16, size=size)
        edges = np.arange(size + 1) * (16 / size)
        columns = (edges[:-1] >= 3) & (edges[1:] <= 16)
        rows = edges[1:] <= 9
        assert not crop.inside(16, 11)[~(rows[:, None] & columns)].any()
        assert crop.inside(16, 11).sum() >= (rows.sum() - 1) * (columns.sum() - 1)


def test_foreground_color_removes_the_background_from_soft_edges() -> None:
    # A red disc over blue, its edge mixed by alpha: straight-alpha colour is red wherever alpha
    # counts, although the picture is purple there.
    rows, columns = np.mgrid[0:96, 0:96]
    alpha = np.clip((30 - np.hypot(rows - 48, columns - 48)) / 8 + 0.5, 0, 1).astype(np.float32)
    red, blue = np.array([200.0, 30, 30]), np.array([20.0, 40, 220])
    mixed = alpha[..., None] * red + (1 - alpha[..., None]) * blue
    color = foreground_color(np.round(mixed).astype(np.uint8), alpha)
    edge = (alpha > 0.3) & (alpha < 0.9)
    error = np.abs(color[edge] - red).mean()
    assert error < 12
    assert error < 0.3 * np.abs(mixed[edge] - red).mean()


def _tube(rings: int = 12, around: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A closed-top tube seen from the side: a head on a neck, open at the bottom."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    height = np.linspace(200, 40, rings)
    points = [[100 + 40 * np.cos(a), h] for h in height for a in angle] + [[100.0, 38.0]]
    faces = []
    for ring in range(rings - 1):
        for k in range(around):
            a, b = ring * around + k, ring * around + (k + 1) % around
            faces += [[a, b, b + around], [a, b + around, a + around]]
    top = (rings - 1) * around
    faces += [[top + k, top + (k + 1) % around, rings * around] for k in range(around)]
    return np.array(points), np.array(faces)


def test_head_region_keeps_hair_and_fades_out_below_the_neck() -> None:
    points, faces = _tube()
    ring = neck_ring(faces)
    np.testing.assert_array_equal(ring, np.arange(24))
    forehead, chin = np.array([100.0, 60.0]), np.array([100.0, 150.0])
    with_neck = np.eye(5)[np.ones(len(points), dtype=int)]
    head_mask = HeadMask(faces, with_neck)
    region = head_mask(head_mask.outline(points, forehead, chin, 256), 256)
    assert region[100, 100] == pytest.approx(1, abs=1e-3)
    assert region[25, 100] > 0.95, "hair above the skull"
    assert region[80, 150] > 0.9, "hair beside the skull"
    assert region[180, 160] < 0.05, "shoulders beside the neck"
    assert region[205, 100] < 0.05, "below the neck's end"
    column = region[150:215, 100]
    assert (np.diff(column) <= 1e-4).all()
    assert np.abs(np.diff(column)).max() < 0.15, "a soft fade"
