"""Places on a mesh that move over its edges: SplattingAvatar's walk over triangles."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rgbavatar_ns.head.surface import MeshEdges

_MOST_TRIANGLES = 200
"""That one walk crosses; what has not arrived by then stays where it is."""


class TriangleWalk:
    """Straight walks on a mesh at rest; a walk into another triangle goes on as if unfolded.

    At the mesh's border, at edges of more than two triangles and at triangles without area it goes
    on along the edge. Source: SplattingAvatar (Shao et al. 2024, sec. 3.2) moves its Gaussians over
    edges as they learn; that the way is straight is ours (its release looks for the nearest point).
    """

    def __init__(self, rest_vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> None:
        corners = rest_vertices.detach().double()[faces]
        self._faces = faces
        self._corners = corners
        # Each corner's opposite edge; turned by 90 degrees it leads into the triangle.
        edges = corners.roll(-2, 1) - corners.roll(-1, 1)
        normal = torch.linalg.cross(edges[:, 0], edges[:, 1])
        doubled = normal.norm(dim=1)
        longest = edges.square().sum(-1).amax(1)
        has_area = doubled > 1e-9 * longest
        unit = normal / doubled.clamp(min=1e-300)[:, None]
        inward = torch.linalg.cross(unit[:, None].expand_as(edges), edges)
        length = inward.norm(dim=-1, keepdim=True).clamp(min=1e-300)
        self._inward = torch.where(has_area[:, None, None], inward / length, 0.0)
        # How each barycentric coordinate grows by the metre.
        slope = inward / doubled.clamp(min=1e-300)[:, None, None]
        self._slope = torch.where(has_area[:, None, None], slope, 0.0)
        self.neighbours = triangle_neighbours(faces, has_area)

    @torch.no_grad()
    def __call__(
        self,
        triangle_index: Int[Tensor, "N"],
        barycentric: Float[Tensor, "N 3"],
        change: Float[Tensor, "N 3"],
    ) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"]]:
        """Where N places arrive whose barycentric coordinates are to change by this much.

        Each change lies in its triangle's plane (it sums to 0). The coordinates that are returned
        are not negative and sum to 1.
        """
        triangle = triangle_index.clone()
        place = barycentric.double().clone()
        # In metres: what is left of the way, and by which corner's edge the triangle was entered.
        way = (change.double()[..., None] * self._corners[triangle]).sum(1)
        entered = torch.full_like(triangle, -1)
        walking = torch.arange(len(triangle), device=triangle.device)
        for _ in range(_MOST_TRIANGLES):
            if not len(walking):
                break
            at, left = triangle[walking], way[walking]
            share, crossed = self._until_an_edge(at, place[walking], left, entered[walking])
            grown = torch.linalg.vecdot(self._slope[at], left[:, None])
            place[walking] += share[:, None] * grown
            onward = crossed >= 0
            walking, at, crossed = walking[onward], at[onward], crossed[onward]
            left = (1 - share[onward])[:, None] * left[onward]
            self._cross(walking, at, crossed, left, triangle, place, way, entered)
        place = place.clamp(min=0)
        return triangle, (place / place.sum(1, keepdim=True)).to(barycentric.dtype)

    def _until_an_edge(
        self,
        at: Int[Tensor, "M"],
        place: Float[Tensor, "M 3"],
        left: Float[Tensor, "M 3"],
        entered: Int[Tensor, "M"],
    ) -> tuple[Float[Tensor, "M"], Int[Tensor, "M"]]:
        """The share of the way up to an edge, and the corner opposite to it; 1 and -1 without."""
        grown = torch.linalg.vecdot(self._slope[at], left[:, None])
        shrinks = (grown < 0) & (place + grown < 0)
        # The edge that was just crossed is behind, whatever rounding says.
        shrinks &= entered[:, None] != torch.arange(3, device=at.device)
        share = torch.where(shrinks, (place.clamp(min=0) / -grown.clamp(max=-1e-300)), torch.inf)
        first, corner = share.min(1)
        return first.clamp(max=1), torch.where(first < 1, corner, -1)

    def _cross(
        self,
        walking: Int[Tensor, "M"],
        at: Int[Tensor, "M"],
        crossed: Int[Tensor, "M"],
        left: Float[Tensor, "M 3"],
        triangle: Int[Tensor, "N"],
        place: Float[Tensor, "N 3"],
        way: Float[Tensor, "N 3"],
        entered: Int[Tensor, "N"],
    ) -> None:
        """Into the neighbours, with what is left of the way turned into their planes."""
        beyond = self.neighbours[at, crossed]
        inside = beyond >= 0
        into = torch.where(inside, beyond, at)
        shared = self._faces[into][:, :, None] == self._faces[at][:, None]
        shared &= (crossed[:, None] != torch.arange(3, device=at.device))[:, None]
        through = torch.where(inside, shared.any(2).int().argmin(1), crossed)
        moved = (shared * place[walking][:, None]).sum(2)
        inward = self._inward[at, crossed]
        outwards = -torch.linalg.vecdot(left, inward)
        along = left + outwards[:, None] * inward
        ahead = outwards[:, None] * self._inward[into, through]
        way[walking] = torch.where(inside[:, None], along + ahead, along)
        triangle[walking], place[walking], entered[walking] = into, moved, through


def triangle_neighbours(
    faces: Int[Tensor, "F 3"], usable: Bool[Tensor, "F"] | None = None
) -> Int[Tensor, "F 3"]:
    """The triangle beyond the edge opposite of each corner; -1 at borders and where more meet.

    Triangles that are not `usable` are nobody's neighbours.
    """
    edges = MeshEdges.of(faces)
    edge, count = edges.of_faces[:, [1, 2, 0]].flatten(), edges.num_faces
    owner = torch.arange(len(faces), device=faces.device).repeat_interleave(3)
    # Of the two triangles of an edge the other one is the sum less oneself.
    total = torch.zeros_like(count).index_add_(0, edge, owner)
    other = torch.where(count[edge] == 2, total[edge] - owner, -1)
    if usable is not None:
        other = torch.where((other >= 0) & usable[other], other, -1)
    return other.view(-1, 3)
