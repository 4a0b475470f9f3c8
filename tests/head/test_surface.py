import numpy as np
import torch
import trimesh

from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.surface import MeshEdges, interpolated, vertex_normals


def test_normals_are_the_sums_of_area_normals_around_each_vertex() -> None:
    head = HeadModel.embedded(torch.float64)
    vertices = head(torch.zeros(2, head.layout.size, dtype=torch.float64))
    mesh = trimesh.Trimesh(vertices[1].numpy(), head.faces.numpy(), process=False)
    sums = np.zeros((len(mesh.vertices), 3))
    for corner in range(3):
        np.add.at(sums, mesh.faces[:, corner], mesh.face_normals * mesh.area_faces[:, None])
    sums /= np.linalg.norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(vertex_normals(vertices, head.faces)[1], sums, atol=1e-9)


def test_interpolation_is_the_weighted_sum_with_gradients_to_values_and_places() -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 5, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = torch.rand(6, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    corners = torch.tensor([[0, 1, 2], [2, 1, 3], [4, 4, 0], [3, 2, 1], [0, 2, 4], [1, 3, 4]])
    wanted = torch.einsum("nk,bnkc->bnc", weights, values[:, corners])
    torch.testing.assert_close(interpolated(values, corners, weights), wanted)
    assert torch.autograd.gradcheck(lambda v, w: interpolated(v, corners, w), (values, weights))


def test_edges_are_those_of_trimesh_with_the_faces_around_them() -> None:
    head = HeadModel.embedded()
    faces = torch.cat([head.faces, head.faces[:1]])  # three faces meet at the edges of the first
    mesh = trimesh.Trimesh(head.arrays.v_template, faces.numpy(), process=False)
    edges = MeshEdges.of(faces)
    assert torch.equal(edges.ends, edges.ends.sort(1).values)
    wanted = {tuple(edge) for edge in np.sort(mesh.edges_unique, 1).tolist()}
    assert {tuple(edge) for edge in edges.ends.tolist()} == wanted
    assert len(edges.ends) == len(wanted)
    for k in range(3):
        corners = torch.stack([faces[:, k], faces[:, (k + 1) % 3]], 1).sort(1).values
        assert torch.equal(edges.ends[edges.of_faces[:, k]], corners)
    around = torch.bincount(edges.of_faces.flatten(), minlength=len(edges.ends))
    assert torch.equal(edges.num_faces, around)
    assert 1 in around
    assert 3 in around
