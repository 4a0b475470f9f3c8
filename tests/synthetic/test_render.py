import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.synthetic import DemoConfig, DemoPerson, film_demo
from rgbavatar_ns.synthetic.make import as_pinhole

BROWS_UP = {"browInnerUp": 0.9, "browOuterUpLeft": 0.9, "browOuterUpRight": 0.9}
SMILE = {
    "mouthSmileLeft": 0.9,
    "mouthSmileRight": 0.9,
    "cheekSquintLeft": 0.5,
    "cheekSquintRight": 0.5,
}
FROWN = {"browDownLeft": 0.9, "browDownRight": 0.9}


SIZE = 96


@pytest.fixture(scope="session")
def person() -> DemoPerson:
    return DemoPerson.of(DemoConfig(image_size=SIZE))


@pytest.fixture(scope="session")
def person_without_glasses() -> DemoPerson:
    return DemoPerson.of(DemoConfig(image_size=SIZE, glasses=False))


@pytest.fixture(scope="session")
def person_without_wrinkles() -> DemoPerson:
    return DemoPerson.of(DemoConfig(image_size=SIZE, wrinkles=0.0))


@pytest.fixture(scope="session")
def theta_of(person):
    """Theta from expression coefficients by name and other fields as lists."""
    layout, names = person.head.layout, person.head.arrays.expression_names

    def make(expression: dict[str, float] | None = None, **fields: list[float]) -> torch.Tensor:
        theta = layout.join({name: torch.tensor(value) for name, value in fields.items()} | zero)
        for name, value in (expression or {}).items():
            theta[names.index(name)] = value
        return theta

    zero = {"expression": torch.zeros(len(names))}
    return make


def draw(person, *thetas) -> list[np.ndarray]:
    return list(person.draw(torch.stack(thetas)))


def test_a_moment_is_the_same_to_the_bit_alone_and_among_others(person):
    film = film_demo(DemoConfig(num_frames=20, num_test_frames=4))
    together = list(person.moments(film.true))
    for number in (0, 7, 19):
        alone = next(person.moments(film.true[number : number + 1]))
        np.testing.assert_array_equal(alone.tracked, together[number].tracked)
        np.testing.assert_array_equal(alone.head_shift_m, together[number].head_shift_m)


def project(person, points: np.ndarray) -> np.ndarray:
    """World points to pixels through the dataset's own OpenCV camera."""
    camera = as_pinhole(person.camera)
    matrix = camera.world_to_camera[0].numpy()
    seen = points @ matrix[:3, :3].T + matrix[:3, 3]
    return seen[:, :2] / seen[:, 2:] * camera.focal_px.numpy() + camera.principal_point_px.numpy()


def silhouette(person, theta) -> np.ndarray:
    """The tracked mesh's triangles filled one by one: [S, S] in [0, 1]."""
    scale = 8
    vertices = person.head(theta, person.identity).numpy()
    corners = (project(person, vertices) * scale - 0.5)[person.head.arrays.faces]
    mask = np.zeros((person.camera.size * scale,) * 2, np.uint8)
    for triangle in corners.round().astype(np.int32):
        cv2.fillConvexPoly(mask, triangle, (1,))
    return cv2.resize(
        mask.astype(np.float32), (person.camera.size,) * 2, interpolation=cv2.INTER_AREA
    )


def difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs(first.astype(float) - second.astype(float)).max(-1)


def box(person, theta, low, high) -> tuple[slice, slice]:
    """Image rows and columns of the template's box [low, high] (metres) after theta moved it."""
    template = person.head.arrays.v_template
    inside = ((template > low) & (template < high)).all(1)
    place = project(person, person.head(theta, person.identity).numpy()[inside])
    first, end = np.floor(place.min(0)).astype(int), np.ceil(place.max(0)).astype(int)
    return slice(first[1], end[1]), slice(first[0], end[0])


@pytest.mark.parametrize("neck", [[0.0, 0.0, 0.0], [0.1, 0.4, 0.1]])
def test_alpha_covers_the_tracked_mesh(person_without_glasses, theta_of, neck):
    theta = theta_of(neck=neck, translation=[0.01, 0.0, 0.02])
    alpha = draw(person_without_glasses, theta)[0][..., 3] / 255.0
    mesh = silhouette(person_without_glasses, theta)
    overlap = np.minimum(alpha, mesh).sum() / np.maximum(alpha, mesh).sum()
    assert overlap > 0.90  # the rest is hair, which the tracked mesh lacks
    below_hair = slice(int(0.45 * person_without_glasses.camera.size), None)
    skin = np.minimum(alpha, mesh)[below_hair].sum() / np.maximum(alpha, mesh)[below_hair].sum()
    assert skin > 0.975


def test_alpha_is_soft_at_the_edge_and_nowhere_else(person, theta_of):
    alpha = draw(person, theta_of())[0][..., 3]
    soft = (alpha > 0) & (alpha < 255)
    assert len(np.unique(alpha)) > 5
    assert 0.005 < soft.mean() < 0.06
    solid = cv2.erode((alpha > 0).astype(np.uint8), np.ones((5, 5), np.uint8))
    assert (alpha[solid > 0] == 255).mean() > 0.995


def test_the_same_moment_looks_the_same_again(person, theta_of):
    first, second = draw(person, theta_of(SMILE), theta_of(SMILE))
    assert np.array_equal(first, second)


def test_reflections_in_the_glasses_depend_on_the_pose(person, person_without_glasses, theta_of):
    """Seen from the head, a lens shows something else after a turn; the eye behind it does not."""
    streaks = []
    for yaw in (-0.3, 0.0, 0.3):
        theta = theta_of(neck=[0.0, yaw, 0.0])
        area = box(person, theta, (0.015, 0.015, 0.02), (0.045, 0.045, 0.06))
        with_lens = draw(person, theta)[0][area][..., :3].astype(float)
        without = draw(person_without_glasses, theta)[0][area][..., :3].astype(float)
        streaks.append(np.clip(with_lens - without, 0, None).mean())
    assert max(streaks) > min(streaks) + 4


@pytest.mark.parametrize(
    ("expression", "low", "high", "calm_part"),
    [
        (BROWS_UP, (-0.04, 0.062, 0.03), (0.04, 0.085, 0.1), FROWN),
        (SMILE, (0.018, -0.045, 0.02), (0.04, -0.012, 0.07), BROWS_UP),
        (FROWN, (-0.01, 0.04, 0.03), (0.01, 0.055, 0.08), SMILE),
    ],
    ids=["forehead", "nasolabial", "glabella"],
)
def test_wrinkles_come_with_their_expression_only(
    person, person_without_wrinkles, theta_of, expression, low, high, calm_part
):
    change = {}
    for name, shapes in (("own", expression), ("other", calm_part), ("none", {})):
        theta = theta_of(shapes)
        area = box(person, theta, low, high)
        folded, plain = draw(person, theta)[0], draw(person_without_wrinkles, theta)[0]
        change[name] = difference(folded[area], plain[area]).mean()
    assert change["none"] == 0
    assert change["other"] < 0.5
    assert change["own"] > 2.5


def test_wrinkles_are_not_in_the_tracked_mesh_but_in_the_true_surface(person, theta_of):
    from rgbavatar_ns.synthetic.performer.surface import TrueSurface
    from rgbavatar_ns.synthetic.performer.wrinkles import WRINKLES, wrinkle_activations

    arrays = person.head.arrays
    theta = theta_of(BROWS_UP)
    tracked = person.head(theta, person.identity).numpy()
    coefficients = theta[person.head.layout.slice("expression")].double().numpy()
    folds = wrinkle_activations(coefficients[None], arrays.expression_names)[0]
    assert folds[WRINKLES.index("forehead")] > 0.9
    assert folds[WRINKLES.index("glabella")] == 0
    surface = TrueSurface(arrays, 0, 1.0)
    moved = surface.pose(tracked, folds).vertices - surface.pose(tracked, 0 * folds).vertices
    forehead = (np.abs(surface.template - [0, 0.07, 0.06]) < [0.03, 0.012, 0.03]).all(1)
    assert 3e-4 < np.abs(moved[forehead]).max() < 2e-3
    assert np.abs(moved[surface.template[:, 1] < 0.03]).max() == 0


def test_closed_lids_hide_the_eyes(person_without_glasses, theta_of):
    open_eye, closed = theta_of(), theta_of({"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0})
    images = draw(person_without_glasses, open_eye, closed)
    area = box(person_without_glasses, open_eye, (0.024, 0.026, 0.02), (0.034, 0.033, 0.06))
    redness = [(image[area][..., 0].astype(float) - image[area][..., 2]).mean() for image in images]
    assert redness[1] > redness[0] + 20  # skin instead of a white and a grey iris


def test_the_room_keeps_its_light_while_the_head_turns(person_without_glasses, theta_of):
    turned = [theta_of(neck=[0.0, yaw, 0.0]) for yaw in (-0.4, 0.4)]
    cheek = ((0.03, -0.02, 0.0), (0.05, 0.01, 0.06))
    brightness = [
        image[box(person_without_glasses, theta, *cheek)][..., :3].mean()
        for theta, image in zip(turned, draw(person_without_glasses, *turned))
    ]
    assert brightness[0] > brightness[1] + 15
