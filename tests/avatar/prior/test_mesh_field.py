"""Values over the mesh: continued as a dense solver says, to both sides of the face alike."""

import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.arrays import EMBEDDED_BUST, EMBEDDED_HEAD
from rgbavatar_ns.head.surface import vertex_normals


def embedded_avatar(
    uv_resolution: int = 48, num_bases: int = 2, name: str = EMBEDDED_HEAD
) -> Avatar:
    head = HeadModel.embedded(name=name)
    config = AvatarConfig(
        num_bases=num_bases, uv_resolution=uv_resolution, scale_from_texel_spacing=True
    )
    return Avatar(head, torch.zeros(head.num_identity), config)


def test_the_continuation_solves_its_equations(make_avatar):
    field = MeshField(make_avatar())
    count, random = field.num_vertices, torch.Generator().manual_seed(0)
    values = torch.rand(count, 2, generator=random)
    confidence = (torch.rand(count, generator=random) > 0.6).float()
    stiffness = 0.1 + torch.rand(len(field.edges), generator=random)
    # An edge pulls both ways alike.
    first, second = field.edges.unbind(1)
    weights = torch.zeros(count, count).index_put((first, second), stiffness)
    weights = 0.5 * (weights + weights.T)
    found = field.continued(
        values,
        confidence,
        torch.zeros_like(values),
        stiffness=weights[first, second],
        rest=0.01,
        iterations=400,
    )
    there = 0.3 * field._mirrored * confidence[field._mirror]
    system = torch.diag(confidence + there + 0.01 + weights.sum(1)) - weights
    wanted = confidence[:, None] * values + there[:, None] * values[field._mirror]
    assert torch.allclose(found, torch.linalg.solve(system, wanted), atol=1e-4)


def test_a_surface_off_the_mesh_does_not_gape_over_its_edges():
    avatar = embedded_avatar()
    rest = avatar.carrier_vertices(torch.zeros(1, avatar.layout.size))
    thick = rest + 0.03 * vertex_normals(rest, avatar.head.faces.long())
    frames = avatar.anchors.frames(rest)
    off = torch.einsum("nij,nj->ni", frames.matrix[0], 0.03 * MeshField(avatar).outwards)
    assert torch.allclose(frames.origin + off, avatar.anchors.origins(thick), atol=1e-6)


def test_a_constant_stays_one_wherever_it_is_known():
    avatar = embedded_avatar()
    field = MeshField(avatar)
    rest = avatar.carrier_vertices(torch.zeros(1, avatar.layout.size))
    front = (avatar.anchors.origins(rest)[0, :, 2] > 0.06).float()
    known, confidence = field.of_gaussians(torch.full((len(front), 1), 0.7), front)
    assert 0 < int((confidence > 0).sum()) < len(confidence) / 2
    found = field.continued(
        known, confidence, 0.7 * torch.ones_like(known), stiffness=0.02, rest=0.0, iterations=30
    )
    assert torch.allclose(field.at_gaussians(found), torch.full((len(front), 1), 0.7), atol=1e-3)


def test_what_one_side_of_the_face_shows_tells_of_the_other():
    avatar = embedded_avatar()
    field = MeshField(avatar)
    x_m = torch.as_tensor(avatar.head.arrays.v_template)[:, 0]
    left = (x_m > 0.02).float()
    found = field.continued(
        x_m.abs()[:, None], left, torch.zeros(len(x_m), 1), stiffness=1e-3, rest=0.0, iterations=600
    )[:, 0]
    right = x_m < -0.02
    assert float((found - x_m.abs())[right].abs().median()) < 2e-3


def test_hair_goes_on_over_the_temples_and_hardly_over_the_ears():
    field = MeshField(embedded_avatar())
    eyes_m = 0.03  # about where the template's eyes lie
    first, second = field.edges.unbind(1)
    across = field.scalp[first] != field.scalp[second]
    height_m = field.height_m[first].minimum(field.height_m[second])
    above, beside = across & (height_m > eyes_m + 0.06), across & (height_m < eyes_m)
    assert int(above.sum()) > 20
    assert int(beside.sum()) > 20
    assert bool((field.links[above] == 1).all())
    assert float(field.links[beside].max()) < 0.01


def test_the_matrix_of_the_edges_is_one_that_every_library_reads():
    """Not contiguous indices are read wrong on a GPU, and nobody checks them there."""
    field = MeshField(embedded_avatar())
    entries = torch.rand(len(field.edges))
    matrix = field._matrix(entries)
    parts = matrix.crow_indices(), matrix.col_indices(), matrix.values()
    torch.sparse_csr_tensor(*parts, matrix.shape, check_invariants=True)
    assert matrix.shape == (field.num_vertices, field.num_vertices)
    first, second = field.edges.unbind(1)
    expected = torch.zeros(matrix.shape).index_put((first, second), entries)
    assert torch.equal(matrix.to_dense(), expected)


def test_a_neck_s_back_has_its_front_s_colour_whatever_lies_below():
    """Light skin in front, a dark shirt and dark hair: the back of the neck is no mixture."""
    field = MeshField(embedded_avatar(name=EMBEDDED_BUST))
    middle = (field.rest_m[:, 1] > -0.09) & (field.rest_m[:, 1] < -0.06) & ~field.body
    skin = ~field.body & ~field.haired
    front = skin & (field.behind_eyes_m < 0.05)
    neck = skin & middle & (field.behind_eyes_m > 0.09)
    assert int(neck.sum()) > 15
    confidence = (front | field.body | field.haired).float()
    values = skin.float()[:, None]

    def found(stiffness):
        return field.continued(
            values, confidence, 1 - values, stiffness=stiffness, rest=1e-6, iterations=300
        )[neck, 0]

    assert float(found(0.02 * field.color_links).min()) > 0.75
    # What is no colour, as how far clothes stand off, goes on over the border.
    assert float(found(0.02).mean()) < 0.6
