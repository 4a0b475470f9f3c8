"""Where the Gaussians sit on the head: from vertices to one tangent frame a Gaussian."""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import (
    HeadModel,
    UVAnchors,
    edges_to_frame,
    frame_quats_wxyz,
    tangent_frames,
)
from rgbavatar_ns.head.surface import interpolated


@dataclass(frozen=True)
class AnchorFrames:
    """Each Gaussian's tangent frame in the world: columns T, B, N, its rotation, its origin.

    `length_ratio` is the root of the triangle's area over its area at rest, where asked for.
    """

    matrix: Float[Tensor, "B N 3 3"]
    quat_wxyz: Float[Tensor, "B N 4"]
    origin: Float[Tensor, "B N 3"]
    length_ratio: Float[Tensor, "B N"] | None = None


class GaussianAnchors(nn.Module):
    """N fixed places on a head's triangles (paper, sec. 3.2: Gaussians never change triangle).

    Triangle and barycentric coordinates are part of the state; the rest is derived from them:
    frames are computed only for triangles that carry a Gaussian.
    """

    triangle_index: Int[Tensor, "N"]
    barycentric: Float[Tensor, "N 3"]
    texel_row_col: Int[Tensor, "N 2"]
    _faces: Int[Tensor, "F 3"]
    _uv: Float[Tensor, "VT 2"]
    _uv_faces: Int[Tensor, "F 3"]
    _rest_vertices: Float[Tensor, "V 3"]
    _frame_index: Int[Tensor, "N"]
    _used_faces: Int[Tensor, "U 3"]
    _used_uv_faces: Int[Tensor, "U 3"]
    _anchor_vertices: Int[Tensor, "N 3"]
    _rest_length: Float[Tensor, "U"]
    _edges_to_frame: Float[Tensor, "U 2 2"]

    def __init__(
        self,
        head: HeadModel,
        anchors: UVAnchors,
        rest_vertices: Float[Tensor, "V 3"],
        variant: Literal["normalized", "raw", "orthonormal"],
    ) -> None:
        super().__init__()
        self.variant: Literal["normalized", "raw", "orthonormal"] = variant
        self.resolution = anchors.resolution
        triangle_index = torch.as_tensor(anchors.triangle_index).long()
        barycentric = torch.as_tensor(anchors.barycentric).to(rest_vertices.dtype)
        self.register_buffer("triangle_index", triangle_index)
        self.register_buffer("barycentric", barycentric)
        for name, tensor in (
            ("texel_row_col", torch.as_tensor(anchors.texel_row_col).long()),
            ("_faces", head.faces.long()),
            ("_uv", head.uv.to(rest_vertices.dtype)),
            ("_uv_faces", head.uv_faces.long()),
            ("_rest_vertices", rest_vertices.detach()),
        ):
            self.register_buffer(name, tensor.clone(), persistent=False)
        self._derive()
        self.register_load_state_dict_post_hook(lambda module, _: module._derive())

    @torch.no_grad()
    def _derive(self) -> None:
        """Recompute what follows from the triangles, at the start and after loading others."""
        used, frame_index = torch.unique(self.triangle_index, return_inverse=True)
        # Sorted, so the ends say it of all.
        if len(used) and not 0 <= int(used[0]) <= int(used[-1]) < len(self._faces):
            raise UserError(
                "A Gaussian's place points outside of the head's triangles.",
                "Use another copy of the avatar or checkpoint.",
            )
        self.register_buffer("_frame_index", frame_index, persistent=False)
        self.register_buffer("_used_faces", self._faces[used], persistent=False)
        self.register_buffer("_used_uv_faces", self._uv_faces[used], persistent=False)
        self.register_buffer("_anchor_vertices", self._faces[self.triangle_index], persistent=False)
        rest_length = self._side_lengths(self._rest_vertices[None])[0]
        self.register_buffer("_rest_length", rest_length, persistent=False)
        inverse = edges_to_frame(self._uv, self._used_uv_faces).to(rest_length.dtype)
        self.register_buffer("_edges_to_frame", inverse, persistent=False)

    def __len__(self) -> int:
        """Return the number N of Gaussians."""
        return len(self.triangle_index)

    def frames(
        self, vertices: Float[Tensor, "B V 3"], *, with_length_ratio: bool = False
    ) -> AnchorFrames:
        """Return the Gaussians' frames on a batch of posed heads (paper, sec. 3.1 and Alg. 1)."""
        matrices = tangent_frames(
            vertices, self._used_faces, self._uv, self._used_uv_faces, variant=self.variant
        )
        quats_wxyz = frame_quats_wxyz(matrices)
        ratio = None
        if with_length_ratio:
            ratio = self._side_lengths(vertices) / self._rest_length
            ratio = ratio.index_select(1, self._frame_index)
        return AnchorFrames(
            matrix=matrices.flatten(2).index_select(1, self._frame_index).unflatten(2, (3, 3)),
            quat_wxyz=quats_wxyz.index_select(1, self._frame_index),
            origin=self.origins(vertices),
            length_ratio=ratio,
        )

    def triangles(self, *, with_rest_length: bool) -> dict[str, Any]:
        """Return what `kernels.MorphedGaussians` holds of the mesh, by its fields' names."""
        return {
            "barycentric": self.barycentric,
            "triangle_of": self._frame_index,
            "triangle_vertices": self._used_faces,
            "edges_to_frame": self._edges_to_frame,
            "rest_length": self._rest_length if with_rest_length else None,
            "variant": self.variant,
        }

    def origins(self, vertices: Float[Tensor, "B V 3"]) -> Float[Tensor, "B N 3"]:
        """Return the anchors' world positions by barycentric interpolation (paper, supplement)."""
        return interpolated(vertices, self._anchor_vertices, self.barycentric)

    def corners(self) -> tuple[Int[Tensor, "N 3"], Float[Tensor, "N 3"]]:
        """Return the vertices of each Gaussian's triangle, and its barycentric coordinates."""
        return self._anchor_vertices, self.barycentric

    def texel_spacing(self) -> Float[Tensor, "N"]:
        """Return the distance in metres between neighbouring texels on the head at rest."""
        corners = self._uv[self._used_uv_faces]
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        uv_area = 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).abs()
        spacing = self._rest_length / (uv_area.sqrt() * self.resolution).clamp(min=1e-12)
        # Slivers of the UV map would give absurd lengths; the median knows the head's size.
        middle = spacing.median()
        return spacing.clamp(middle / 10, middle * 10)[self._frame_index]

    def texel_stretch(self) -> Float[Tensor, "N 2"]:
        """Return how far texels lie apart along u and along v, over `texel_spacing`; 1/3 to 3."""
        corners, places = self._uv[self._used_uv_faces], self._rest_vertices[self._used_faces]
        uv_sides, sides = (points[:, 1:] - points[:, :1] for points in (corners, places))
        (a, b), (c, d) = (row.unbind(-1) for row in uv_sides.unbind(1))
        area = a * d - b * c
        area = torch.where(area.abs() < 1e-12, 1e-12, area)[:, None]
        first, second = sides.unbind(1)
        along_u = (d[:, None] * first - b[:, None] * second) / area
        along_v = (a[:, None] * second - c[:, None] * first) / area
        lengths = torch.stack([along_u, along_v], 1).norm(dim=-1)
        spacing = self._rest_length / (0.5 * area[:, 0].abs()).sqrt()
        return (lengths / spacing[:, None]).clamp(1 / 3, 3)[self._frame_index]

    def to_state(self) -> dict[str, Any]:
        """Return triangles and barycentric coordinates as tensors, for a checkpoint."""
        return {
            "triangle_index": self.triangle_index.to(torch.int32),
            "barycentric": self.barycentric,
            "texel_row_col": self.texel_row_col.to(torch.int32),
            "resolution": self.resolution,
        }

    def _side_lengths(self, vertices: Float[Tensor, "B V 3"]) -> Float[Tensor, "B U"]:
        """Return the root of the area of every triangle that carries a Gaussian."""
        corner, *others = vertices[:, self._used_faces].unbind(2)
        doubled = torch.linalg.cross(others[0] - corner, others[1] - corner, dim=-1)
        return (0.5 * torch.linalg.vector_norm(doubled, dim=-1)).clamp(min=1e-16).sqrt()
