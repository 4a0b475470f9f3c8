"""How a posed mesh carries Gaussians, beside RGBAvatar's tangent frames: by edges, by vertices, by
bones.

What frames carry, `avatar.model.tangent_to_world.carried` puts into the world. A carrier in the
world itself (FlashAvatar) is `head.surface.interpolated` plus an offset, and needs no more.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.avatar.model.anchors import AnchorFrames
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import edge_rotations
from rgbavatar_ns.head.rotations import (
    conjugate_quats_wxyz,
    matrix_to_quat_wxyz,
    multiply_quats_wxyz,
)
from rgbavatar_ns.head.surface import interpolated

_LEAST_LENGTH_M = 1e-8


def edge_frames(
    vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"], triangle_index: Int[Tensor, "N"]
) -> AnchorFrames:
    """Frames of triangles that grow with them: x = k R x_l + c, s = k s_l, q = R q_l.

    c is the centroid; R's columns are the direction of the first edge, the normal, and the third
    that makes them a rotation; k, metres, is the mean of that edge's length and of the height upon
    it: `matrix` is k R, `length_ratio` k. Triangles without area have the world's axes. Source:
    GaussianAvatars (Qian et al. 2024, sec. 3.2; `compute_face_orientation` of its release).
    """
    along_edge, in_plane, normal = edge_rotations(vertices, faces).unbind(-1)
    rotation = torch.stack([along_edge, normal, -in_plane], -1)
    corner, second, third = vertices[:, faces].unbind(2)
    height = ((third - corner) * in_plane).sum(-1).abs()
    size = 0.5 * (torch.linalg.vector_norm(second - corner, dim=-1) + height)
    size = size.clamp(min=_LEAST_LENGTH_M)
    matrix = rotation * size[..., None, None]
    return AnchorFrames(
        matrix=matrix.flatten(2).index_select(1, triangle_index).unflatten(2, (3, 3)),
        quat_wxyz=matrix_to_quat_wxyz(rotation).index_select(1, triangle_index),
        origin=((corner + second + third) / 3).index_select(1, triangle_index),
        length_ratio=size.index_select(1, triangle_index),
    )


@dataclass(frozen=True)
class SurfaceFrames:
    """Places on a posed mesh's smooth surface, and how it has turned and grown there since rest.

    `normal` and `quat_wxyz` have length one; `area_ratio` is the triangle's area over that at rest.
    """

    origin: Float[Tensor, "B N 3"]
    normal: Float[Tensor, "B N 3"]
    quat_wxyz: Float[Tensor, "B N 4"]
    area_ratio: Float[Tensor, "B N"]

    def means(self, offset_m: Float[Tensor, "#B N"]) -> Float[Tensor, "B N 3"]:
        """Points that far outside of the surface, along its normal."""
        return torch.addcmul(self.origin, self.normal, offset_m[..., None])

    def turned(self, rotation_wxyz: Float[Tensor, "#B N 4"]) -> Float[Tensor, "B N 4"]:
        """Rotations that are given at rest, as the surface has turned them."""
        return multiply_quats_wxyz(self.quat_wxyz, rotation_wxyz)


class SmoothSurface(nn.Module):
    """A mesh whose normals and rotations are those of its vertices, interpolated in triangles.

    A vertex has turned since rest as the triangles around it have, weighed by their area at rest.
    Quaternions are blended with the sign that is nearer to the whole mesh's mean: a triangle that
    has turned half around against it has either. `damping_m2` is added to both areas. Source:
    SplattingAvatar (Shao et al. 2024, sec. 3.1; `utils/map.py` of its release, whose damping of
    1e-4 for a head four times as large is 6.25e-6 m^2 here).
    """

    faces: Int[Tensor, "F 3"]
    _rest_area: Float[Tensor, "F"]
    _to_rest_wxyz: Float[Tensor, "F 4"]
    _corner_faces: Int[Tensor, "F3"]
    _corner_starts: Int[Tensor, "V"]

    def __init__(
        self,
        rest_vertices: Float[Tensor, "V 3"],
        faces: Int[Tensor, "F 3"],
        damping_m2: float = 6.25e-6,
    ) -> None:
        super().__init__()
        self.damping_m2 = damping_m2
        rest = rest_vertices.detach()
        area = torch.linalg.vector_norm(_area_normals(rest[None], faces)[0], dim=-1)
        # Corners in the order of their vertices, so that each vertex's lie together.
        order = torch.argsort(faces.flatten(), stable=True)
        around = torch.bincount(faces.flatten(), minlength=len(rest))
        for name, values in (
            ("faces", faces.clone()),
            ("_rest_area", area),
            ("_to_rest_wxyz", conjugate_quats_wxyz(_edge_quats_wxyz(rest[None], faces)[0])),
            ("_corner_faces", order // 3),
            ("_corner_starts", around.cumsum(0) - around),
        ):
            self.register_buffer(name, values, persistent=False)

    def frames(
        self,
        vertices: Float[Tensor, "B V 3"],
        triangle_index: Int[Tensor, "N"],
        barycentric: Float[Tensor, "N 3"],
    ) -> SurfaceFrames:
        """The surface at N places of posed heads; gradients reach vertices and barycentrics."""
        area_normal, quats = _area_normals(vertices, self.faces), self._weighed_quats(vertices)
        around = self._around_vertices(torch.cat([area_normal, quats], -1)).split([3, 4], -1)
        known = torch.cat([vertices, *(F.normalize(mean, dim=-1) for mean in around)], -1)
        corners = self.faces[triangle_index]
        found = interpolated(known, corners, barycentric)
        origin, normal, quat_wxyz = found.split([3, 3, 4], -1)
        area = torch.linalg.vector_norm(area_normal, dim=-1)
        ratio = (area + self.damping_m2) / (self._rest_area + self.damping_m2)
        return SurfaceFrames(
            origin=origin,
            normal=F.normalize(normal, dim=-1),
            quat_wxyz=F.normalize(quat_wxyz, dim=-1),
            area_ratio=ratio.index_select(1, triangle_index),
        )

    def vertex_quats_wxyz(self, vertices: Float[Tensor, "B V 3"]) -> Float[Tensor, "B V 4"]:
        """How each vertex has turned since rest, as unit quaternions of neighbouring signs."""
        return F.normalize(self._around_vertices(self._weighed_quats(vertices)), dim=-1)

    def _weighed_quats(self, vertices: Float[Tensor, "B V 3"]) -> Float[Tensor, "B F 4"]:
        """How triangles have turned, times their areas at rest."""
        quats = multiply_quats_wxyz(_edge_quats_wxyz(vertices, self.faces), self._to_rest_wxyz)
        with torch.no_grad():
            weight = self._rest_area[:, None]
            largest = quats[:, int(self._rest_area.argmax()), None]
            mean = (weight * _towards(quats, largest) * quats).sum(1)
            weight = weight * _towards(quats, mean[:, None])
        return weight * quats

    def _around_vertices(self, values: Float[Tensor, "B F C"]) -> Float[Tensor, "B V C"]:
        """Sums over the triangles that have a corner there."""
        # The batch lies innermost, as in `interpolated`.
        table = values.transpose(0, 1).flatten(1)
        summed = F.embedding_bag(self._corner_faces, table, self._corner_starts, mode="sum")
        return summed.unflatten(1, (len(values), -1)).transpose(0, 1)


def require_places(face_index: Int[Tensor, "N"], faces: Int[Tensor, "F 3"]) -> None:
    """Raise UserError where a Gaussian, as a file may have it, lies on no triangle of the head."""
    if len(face_index) and not 0 <= int(face_index.min()) <= int(face_index.max()) < len(faces):
        raise UserError(
            "A Gaussian's place points outside of the head's triangles.",
            "Use another copy of the avatar or checkpoint.",
        )


def skinning_frames(
    weights: Float[Tensor, "N J"], joint_transforms: Float[Tensor, "B J 4 4"]
) -> AnchorFrames:
    """Frames of points that bones carry: x = A x_rest + t, where A and t are blended by weights.

    The rotation is the blend's unit quaternion, near the nearest rotation as long as the bones
    agree within some tens of degrees. Source: linear blend skinning; so GaussianBlendshapes and
    MonoGaussianAvatar, with `HeadModel.joint_transforms`.
    """
    blended = torch.matmul(weights, joint_transforms[:, :, :3].flatten(2)).unflatten(2, (3, 4))
    matrix = blended[..., :3]
    quat_wxyz = F.normalize(matrix_to_quat_wxyz(matrix), dim=-1)
    return AnchorFrames(matrix=matrix, quat_wxyz=quat_wxyz, origin=blended[..., 3])


def _edge_quats_wxyz(
    vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "B F 4"]:
    """Rotations of triangles, by their first edge and normal."""
    return matrix_to_quat_wxyz(edge_rotations(vertices, faces))


def _area_normals(
    vertices: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "B F 3"]:
    """Outward normals as long as the triangles' areas."""
    corner, second, third = vertices[:, faces].unbind(2)
    return 0.5 * torch.linalg.cross(second - corner, third - corner, dim=-1)


def _towards(quats: Float[Tensor, "B F 4"], aim: Float[Tensor, "B 1 4"]) -> Float[Tensor, "B F 1"]:
    """1, or -1 where the opposite quaternion is nearer to the aim."""
    return 1 - 2 * ((quats * aim).sum(-1, keepdim=True) < 0).to(quats)
