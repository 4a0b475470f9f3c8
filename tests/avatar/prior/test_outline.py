"""Outlines of mattes: a person drawn thicker than the mesh is found to be as thick."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.avatar.prior.outline import measure_outline
from rgbavatar_ns.avatar.prior.placed_mesh import PlacedMesh
from rgbavatar_ns.head.arrays import EMBEDDED_BUST
from rgbavatar_ns.head.surface import vertex_normals
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.kernels.constants import UNFILMED_RGBA

from .test_mesh_field import embedded_avatar

SIZE = 256


def front_camera(focal_px: float = 900.0) -> PinholeCameras:
    world_to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))[None]
    world_to_camera[0, 2, 3] = 1.1
    middle_px = torch.full((1, 2), SIZE / 2)
    return PinholeCameras(world_to_camera, torch.full((1, 2), focal_px), middle_px, SIZE, SIZE)


def drawn_thicker(
    avatar, theta: torch.Tensor, thickness_m: float, camera: PinholeCameras | None = None
) -> torch.Tensor:
    """The mesh as a pinhole sees it, widened by a disc that is as large as the thickness."""
    camera, images = camera or front_camera(), []
    for vertices in avatar.carrier_vertices(theta):
        seen = vertices @ camera.world_to_camera[0, :3, :3].T + camera.world_to_camera[0, :3, 3]
        px = (seen[:, :2] / seen[:, 2:] * camera.focal_px + camera.principal_point_px).numpy()
        mask = np.zeros((SIZE * 4, SIZE * 4), np.uint8)
        for triangle in px[avatar.head.faces.numpy()]:
            cv2.fillConvexPoly(mask, np.round(triangle * 4 * 16).astype(np.int32), (1,), shift=4)
        radius = round(4 * abs(thickness_m) / 1.1 * float(camera.focal_px[0, 0]))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        change = cv2.dilate if thickness_m > 0 else cv2.erode
        mask = change(mask, disc, borderValue=0 if thickness_m > 0 else 1)
        alpha = cv2.resize(mask * 255, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        images.append(np.dstack([np.full((SIZE, SIZE, 3), 128, np.uint8), alpha]))
    return torch.from_numpy(np.stack(images))


def turned(avatar, degrees: list[float]) -> torch.Tensor:
    theta = torch.zeros(len(degrees), avatar.layout.size)
    theta[:, avatar.layout.slice("rotation").start + 1] = torch.deg2rad(torch.tensor(degrees))
    return theta


@pytest.mark.parametrize("thickness_m", [0.0, 0.01, -0.004])
def test_the_outline_tells_how_thick_the_person_is(thickness_m: float):
    avatar = embedded_avatar()
    theta = turned(avatar, [-8.0, -3.0, 2.0, 8.0])
    images = drawn_thicker(avatar, theta, thickness_m)
    found = measure_outline(avatar, MeshField(avatar), theta, front_camera(), images)
    v_template = torch.as_tensor(avatar.head.arrays.v_template)
    crown = v_template[:, 1] > v_template[:, 1].max() - 0.02
    assert float(found.offset_m[crown].median()) == pytest.approx(thickness_m, abs=2e-3)
    assert float(found.empty.mean()) < 0.01 or thickness_m < 0


def test_what_nobody_filmed_is_no_outline():
    avatar = embedded_avatar()
    theta = turned(avatar, [0.0, 4.0])
    images = drawn_thicker(avatar, theta, 0.0)
    images[:, : SIZE // 2] = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    found = measure_outline(avatar, MeshField(avatar), theta, front_camera(), images)
    v_template = torch.as_tensor(avatar.head.arrays.v_template)
    crown = v_template[:, 1] > v_template[:, 1].max() - 0.02
    assert float(found.offset_m[crown].abs().max()) < 2e-3
    assert not found.empty[crown].any()


def test_where_mattes_show_background_the_surface_is_empty():
    avatar = embedded_avatar()
    theta = turned(avatar, [0.0, 4.0])
    images = drawn_thicker(avatar, theta, 0.0)
    images[:, SIZE * 2 // 3 :] = 0
    found = measure_outline(avatar, MeshField(avatar), theta, front_camera(), images)
    y_m = torch.as_tensor(avatar.head.arrays.v_template)[:, 1]
    assert float(found.empty[(y_m > -0.13) & (y_m < -0.1)].mean()) > 0.95
    assert float(found.empty[y_m > 0.0].mean()) < 0.01


def test_what_lies_below_every_picture_is_as_empty_as_what_is_above_it():
    avatar = embedded_avatar()
    theta = turned(avatar, [0.0, 4.0])
    theta[:, avatar.layout.slice("translation").start + 1] = -0.05
    images = drawn_thicker(avatar, theta, 0.0)
    y_m = torch.as_tensor(avatar.head.arrays.v_template)[:, 1]
    below = y_m < y_m.min() + 0.01  # the lowest centimetre of the neck is in no picture
    for faded in (False, True):
        if faded:
            images[:, SIZE - 30 :] = 0
        found = measure_outline(avatar, MeshField(avatar), theta, front_camera(), images)
        assert bool((found.empty[below] > 0.5).all()) == faded
        assert not (found.empty[y_m > 0] > 0.5).any()


def test_a_body_whose_clothes_stand_high_is_lifted_to_the_end_of_its_matte():
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field = MeshField(avatar)
    theta = turned(avatar, [-4.0, 0.0, 4.0])
    theta[:, avatar.layout.slice("translation").start + 1] = 0.1
    images = drawn_thicker(avatar, theta, 0.0)
    below = images.clone()
    below[:, :145] = 0  # shoulders, without the neck
    lift_px = 40  # 49 mm, farther than hair is looked for
    kernel = np.zeros((2 * lift_px + 1, 1), np.uint8)
    kernel[lift_px:] = 1
    alpha = [cv2.dilate(image[..., 3].numpy(), kernel) for image in below]
    images[..., 3] = torch.maximum(images[..., 3], torch.from_numpy(np.stack(alpha)))
    found = measure_outline(avatar, field, theta, front_camera(), images)
    placed = _placed(avatar, theta[1:2], front_camera())
    flat, moved = placed.moved(0.0)[field.body], placed.moved(found.offset_m)[field.body]
    tops = images[1, ..., 3].gt(127).numpy().argmax(0)
    missing = []
    for column in [*range(8, 56, 8), *range(204, 252, 8)]:  # beside the head
        rims = [px[np.abs(px[:, 0] - column) < 6, 1].min() for px in (flat, moved)]
        missing.append([rim - tops[column] for rim in rims])
    before, after = np.median(missing, 0)
    assert before > 0.8 * lift_px
    assert abs(after) < 0.2 * lift_px


def _placed(avatar, theta: torch.Tensor, camera: PinholeCameras) -> PlacedMesh:
    vertices = avatar.carrier_vertices(theta)
    return PlacedMesh.of(vertices, vertex_normals(vertices, avatar.head.faces.long()), camera, 0)


@pytest.mark.parametrize("quarter_turns", [0, 1])
def test_clothes_as_thick_everywhere_lift_no_slope_of_a_shoulder_out_of_them(quarter_turns: int):
    avatar = embedded_avatar(name=EMBEDDED_BUST)
    field, theta = MeshField(avatar), turned(avatar, [-3.0, 0.0, 3.0])
    theta[:, avatar.layout.slice("translation").start + 1] = 0.05
    camera = front_camera(focal_px=400.0)  # both upper arms are in the picture
    roll = torch.eye(4)
    roll[:2, :2] = torch.linalg.matrix_power(torch.tensor([[0.0, -1.0], [1.0, 0.0]]), quarter_turns)
    camera = replace(camera, world_to_camera=roll @ camera.world_to_camera)
    images = drawn_thicker(avatar, theta, 0.025, camera)
    found = measure_outline(avatar, field, theta, camera, images)
    assert float(found.offset_m[field.body].max()) < 0.035
    px = _placed(avatar, theta[1:2], camera).moved(found.offset_m)
    upper = (field.body & (field.normals[:, 1] > 0.5)).numpy()
    inside = upper & (px > 2).all(1) & (px < SIZE - 2).all(1)
    column, row = px[inside].astype(int).T
    assert int(inside.sum()) > 60
    matte = cv2.dilate(images[1, ..., 3].numpy(), np.ones((3, 3), np.uint8))
    assert (matte[row, column] < 128).mean() < 0.05


def test_hair_goes_around_the_head_and_ends_at_the_nape():
    avatar = embedded_avatar()
    theta = turned(avatar, [-8.0, -3.0, 2.0, 8.0])
    images = drawn_thicker(avatar, theta, 0.01)
    v_template = torch.as_tensor(avatar.head.arrays.v_template)
    height_m, depth_m = v_template[:, 1], v_template[:, 2]
    # Only the crown's rim is filmed; nothing is known of the rest.
    unfilmed = torch.tensor(UNFILMED_RGBA, dtype=torch.uint8)
    images[:, SIZE // 3 :] = unfilmed
    found = measure_outline(avatar, MeshField(avatar), theta, front_camera(), images).offset_m
    back = (depth_m < depth_m.min() + 0.02) & (height_m > 0.02)
    nape = (depth_m < -0.06) & (height_m < -0.08)
    assert float(found[back].median()) > 0.006
    assert float(found[nape].abs().max()) < 0.002
