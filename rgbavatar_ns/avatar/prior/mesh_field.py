"""Smooth functions over a head's mesh: known in places, continued to the others."""

import warnings
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.head import HeadArrays
from rgbavatar_ns.head.hair import haired_vertices
from rgbavatar_ns.head.joints import EYES, ROOT
from rgbavatar_ns.head.rotations import turn_back
from rgbavatar_ns.head.surface import MeshEdges, vertex_normals

_BEHIND_EYES_M = 0.095
"""So far behind the eyes lies what is behind the ears."""
_TEMPLE_M, _SIDES_M, _TOP_M = 0.06, 0.045, 0.075
"""So far behind the eyes whoever has hair has it; from so far on, or so far above them, hair is the
rule, and farther in front each has a hairline of one's own."""
_OVER_EARS_M = 0.015
"""From here up hair hangs over the tops of ears, or their colour would go on into it."""
NECK_HAIR_M = 0.05
"""How far below the eyes hair ends, at the ears' lobes: a centimetre lower lie the neck's sides,
where hair as thick as above would stand out as soon as a head turns."""
_ABOVE_EARS_M = 0.04
"""From here up hair goes on to the forehead, or a bald head does."""
_HAIRLINE, _COLLAR = 0.005, 0.005
"""How stiff a link over the border of hair is; and over that of a body, which wears clothes, but
only for colours."""
_MIRROR_REACH_M = 5e-3
_MIRROR_TRUST = 0.3
"""How much what is known of one side of the face tells of the other."""


@dataclass(frozen=True)
class Outline:
    """What mattes say about each of V vertices and N Gaussians."""

    offset_m: Float[Tensor, "V"]
    """How far the person stands off the mesh along its smooth normal."""
    empty: Float[Tensor, "V"]
    """Share of the frames in which the moved vertex lies on background."""
    empty_gaussians: Float[Tensor, "N"]
    """The same of each of N Gaussians; of a body by its own place."""
    goes_on_below: bool
    """Whether mattes show the person below the mesh: a neck, shoulders."""
    hair_contrast: float
    """How far light varies over strands of hair, a share of it: 0 where none are seen."""


class MeshField:
    """The vertices of an avatar's mesh as a graph, and the Gaussians' places in it.

    `outwards` is where a surface off the mesh lies from each Gaussian, in its tangent frame at
    rest: between the vertices' normals, so that it does not gape over the mesh's edges;
    `normal_of_gaussians` is that direction in the axes that their rotations are in, which
    `rest_quats_wxyz` turn to the head's. `rest_m` and
    `normals` are the vertices' own at rest, `height_m`, `behind_eyes_m` and `above_eyes_m` are
    theirs on the template; `body` and `body_gaussians` lie below the neck's foot, `haired` where
    hair is the rule, `scalp` where everybody who has hair has it, `back` (1 or 0) behind the ears,
    `above_ears` above them. All that is continued is by `links`; by `color_links` colours are, too.

    Values are continued harmonically, as heat would spread, to both sides of the face alike. Ours:
    because what nobody filmed is best guessed by what surrounds it.
    """

    def __init__(self, avatar: Avatar) -> None:
        self._corners, self._barycentric = avatar.anchors.corners()
        faces = avatar.head.faces.long()
        template = torch.as_tensor(avatar.head.arrays.v_template).to(self._barycentric)
        self.num_vertices = len(template)
        ends = MeshEdges.of(faces).ends
        first, second = torch.cat([ends, ends.flip(1)]).unbind(1)
        numbers = torch.unique(first * self.num_vertices + second)
        self.edges = torch.stack([numbers // self.num_vertices, numbers % self.num_vertices], 1)
        self._mirror, self._mirrored = _mirror_of(template)
        behind, up = (part.to(template) for part in _behind_and_above_eyes(avatar.head.arrays))
        self.behind_eyes_m, self.above_eyes_m = behind, up
        self.back = (behind > _BEHIND_EYES_M).to(template)
        self.haired = haired_for_certain(avatar.head.arrays).to(template.device)
        self.scalp = self.haired & (behind > _TEMPLE_M)
        self.above_ears = up > _ABOVE_EARS_M
        self.height_m = template[:, 1]
        self.body = body_vertices(avatar.head.arrays).to(template.device)
        first, second = self.edges.unbind(1)
        ends_of_rows = torch.bincount(first, minlength=self.num_vertices).cumsum(0)
        self._row_starts = torch.cat([ends_of_rows.new_zeros(1), ends_of_rows])
        # A GPU's library reads them as they lie, one behind the other.
        self._columns = second.contiguous()
        # Above the ears hair goes on, or a bald head does.
        low = ~self.above_ears
        across = (self.scalp[first] != self.scalp[second]) & low[first] & low[second]
        self.links = torch.where(across, _HAIRLINE, 1.0).to(template)
        dressed = self.body[first] != self.body[second]
        self.color_links = torch.where(dressed, _COLLAR, 1.0).to(template)
        self.body_gaussians = self.at_gaussians(self.body.to(template)[:, None])[:, 0] > 0.5
        with torch.no_grad():
            rest = avatar.head(avatar.identity.new_zeros(1, avatar.layout.size), avatar.identity)
            self.rest_m, self.normals = rest[0], vertex_normals(rest, faces)[0]
            frames = avatar.anchors.frames(rest)
            self.rest_quats_wxyz = frames.quat_wxyz[0]
            smooth = self.at_gaussians(self.normals)
            self.outwards = _solved(frames.matrix[0], smooth)
            self.normal_of_gaussians = F.normalize(turn_back(frames.quat_wxyz[0], smooth), dim=-1)

    def of_gaussians(
        self, values: Float[Tensor, "N C"], confidence: Float[Tensor, "N"]
    ) -> tuple[Float[Tensor, "V C"], Float[Tensor, "V"]]:
        """Each vertex's mean of the Gaussians around it, and their confidence together."""
        shares = self._barycentric * confidence[:, None]
        ones = torch.cat([values, torch.ones_like(values[:, :1])], 1)
        sums = ones.new_zeros(self.num_vertices, ones.shape[1])
        for corner in range(3):
            sums.index_add_(0, self._corners[:, corner], ones * shares[:, corner : corner + 1])
        return sums[:, :-1] / sums[:, -1:].clamp(min=1e-12), sums[:, -1]

    def mean_around(self, of_edges: Float[Tensor, "E"]) -> Float[Tensor, "V"]:
        """Each vertex's mean of its edges."""
        sums = of_edges.new_zeros(self.num_vertices)
        sums.index_add_(0, self.edges[:, 0], of_edges)
        return sums / self._row_starts.diff().clamp(min=1)

    def at_gaussians(self, values: Float[Tensor, "V C"]) -> Float[Tensor, "N C"]:
        """The values of vertices where the Gaussians are."""
        at = values[self._corners] * self._barycentric[:, :, None]
        return at.sum(1)

    def likeness(
        self, colors: Float[Tensor, "V 3"], known: Bool[Tensor, "V"], spread: float, least: float
    ) -> Float[Tensor, "E"]:
        """How far each edge's ends look alike: 1 for the same colour, and where one is unknown."""
        first, second = self.edges.unbind(1)
        apart = (colors[first] - colors[second]).square().sum(1)
        alike = torch.exp(-apart / (2 * spread**2)).clamp(min=least)
        return torch.where(known[first] & known[second], alike, torch.ones_like(alike))

    def continued(
        self,
        values: Float[Tensor, "V C"],
        confidence: Float[Tensor, "V"],
        start: Float[Tensor, "V C"],
        *,
        stiffness: float | Float[Tensor, "E"],
        rest: float | Float[Tensor, "V"],
        iterations: int,
        mirrored: bool = True,
    ) -> Float[Tensor, "V C"]:
        """The smooth function near `values`, as near as `confidence` says, from a first guess.

        Minimises sum confidence (x - values)^2 + rest x^2 + sum over edges stiffness (x_i - x_j)^2
        by conjugate gradients, without waiting for the device. `mirrored`: what is known of one
        side of the face tells of the other too.
        """
        trust = _MIRROR_TRUST if mirrored else 0.0
        there = trust * self._mirrored * confidence[self._mirror]
        weight = (confidence + there)[:, None]
        known = confidence[:, None] * values + there[:, None] * values[self._mirror]
        # Sparse products promote no types.
        neighbours = self._matrix((self.links * stiffness).to(known))
        degree = neighbours @ known.new_ones(self.num_vertices, 1)
        diagonal = weight + (known.new_ones(self.num_vertices) * rest)[:, None] + degree

        def product(x: Tensor) -> Tensor:
            return diagonal * x - neighbours @ x

        return _conjugate_gradients(product, known, start.to(known), diagonal, iterations)

    def _matrix(self, entries: Float[Tensor, "E"]) -> Tensor:
        """The matrix [V, V] with an entry for each edge, sparse by rows."""
        with warnings.catch_warnings():  # torch calls the format new, and its checks left out
            warnings.filterwarnings(
                "ignore", message="Sparse (CSR tensor support|invariant checks)"
            )
            return torch.sparse_csr_tensor(
                self._row_starts,
                self._columns,
                entries,
                (self.num_vertices, self.num_vertices),
                check_invariants=False,
            )


def _solved(frames: Float[Tensor, "N 3 3"], vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Vectors in tangent frames, and the third axis where a triangle has no area."""
    found, failed = torch.linalg.solve_ex(frames, vectors[..., None])
    flat = (failed != 0) | ~found.isfinite().all((1, 2))
    return torch.where(flat[:, None], torch.eye(3).to(vectors)[2], found[..., 0])


def _conjugate_gradients(product, wanted: Tensor, start: Tensor, diagonal: Tensor, iterations: int):
    """Solve each column by itself, preconditioned by the diagonal."""
    x, left = start, wanted - product(start)
    scaled = left / diagonal
    direction, size = scaled, (left * scaled).sum(0)
    for _ in range(iterations):
        image = product(direction)
        step = size / (direction * image).sum(0).clamp(min=1e-30)
        x, left = x + step * direction, left - step * image
        scaled = left / diagonal
        size, before = (left * scaled).sum(0), size
        direction = scaled + size / before.clamp(min=1e-30) * direction
    return x


def ramp(values: Float[Tensor, "*n"], start: float, end: float) -> Float[Tensor, "*n"]:
    """0 up to `start`, 1 from `end` on, which may lie on either side, and a line between."""
    return ((values - start) / (end - start)).clamp(0, 1)


def haired_for_certain(arrays: HeadArrays) -> Bool[Tensor, "V"]:
    """Where a head has hair, if it has any, wherever its hairline runs in front."""
    behind, up = _behind_and_above_eyes(arrays)
    certain = ((behind > _SIDES_M) & (up > -NECK_HAIR_M)) | (up > _TOP_M)
    over_ears = (behind > _TEMPLE_M) & (up > _OVER_EARS_M)
    return (torch.from_numpy(haired_vertices(arrays)) & certain) | over_ears


def _behind_and_above_eyes(arrays: HeadArrays) -> tuple[Float[Tensor, "V"], Float[Tensor, "V"]]:
    """How far each vertex lies behind the eyes, and above them, in metres."""
    eyes = (arrays.joint_regressor[EYES] @ arrays.v_template).mean(0)
    _, up, forward = torch.from_numpy((arrays.v_template - eyes).astype("float32")).unbind(1)
    return -forward, up


def body_vertices(arrays: HeadArrays, higher_m: float = 0.0) -> Bool[Tensor, "V"]:
    """Those below the joint that a neck stands on, or so much higher, of heads with a torso."""
    template = torch.as_tensor(arrays.v_template)
    root = torch.as_tensor(arrays.joint_regressor[ROOT]).to(template) @ template
    return (template[:, 1] < root[1] + higher_m) & arrays.has_torso


def _mirror_of(
    template: Float[Tensor, "V 3"],
) -> tuple[Int[Tensor, "V"], Float[Tensor, "V"]]:
    """Each vertex's partner on the other side of x = 0, and 1 where there is one."""
    places = template.cpu().double().numpy()
    distance, partner = KDTree(places).query(places * [-1, 1, 1])
    found = torch.from_numpy(distance < _MIRROR_REACH_M).to(template)
    return torch.from_numpy(partner).to(template.device), found
