"""A leash for Gaussians: where expressions move the face they stay beside their neighbours."""

import torch
from jaxtyping import Float
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.head.arrays import NECK_SHIFTS

_RATE = 0.01
"""Share of the way to its neighbours' mean that a Gaussian goes in a step."""
_STRETCH = 0.3
"""How much an expression stretches or turns the mesh where the leash has its whole strength."""
_JAW_RAD = 0.3
_ITERATIONS = 30


class Leash:
    """Draws each Gaussian's offset from the mesh towards that of its neighbours. Ours.

    Because frames of a film that hardly moves the mouth do not tell which part of the face a pixel
    belongs to: Gaussians wander by centimetres, and an expression beyond the film tears what they
    paint apart. The offset that they have in common, such as a beard's, stays; so does every one
    where nothing moves, such as in hair, whose depth the head's turn teaches.

    Attributes:
        share: of the way in a step, of each of N Gaussians.
    """

    def __init__(self, avatar: Avatar, field: MeshField) -> None:
        self._field = field
        rest = avatar.carrier_vertices(avatar.identity.new_zeros(1, avatar.layout.size))
        self._to_head = avatar.anchors.frames(rest).matrix[0]
        inverse, failed = torch.linalg.inv_ex(self._to_head)
        flat = (failed != 0) | ~inverse.isfinite().flatten(1).all(1)
        self._to_frame = torch.where(flat[:, None, None], torch.zeros_like(inverse), inverse)
        stretch = field.at_gaussians(_stretch(avatar, field)[:, None])[:, 0]
        self.share = torch.where(flat, 0.0, _RATE * (stretch / _STRETCH).clamp(max=1))

    def smooth(
        self,
        position: Float[Tensor, "N 3"],
        home: Float[Tensor, "N 3"],
        known: Float[Tensor, "N"],
    ) -> Float[Tensor, "N 3"]:
        """Where each would lie with its neighbours' offset from home; all in tangent frames.

        `known` is what each one's own offset counts.
        """
        offset = (self._to_head @ (position - home)[..., None])[..., 0]
        mean, confidence = self._field.of_gaussians(offset, known)
        common = self._field.continued(
            mean,
            confidence.clamp(max=1),
            mean,
            stiffness=1.0,
            rest=1e-6,
            iterations=_ITERATIONS,
            mirrored=False,
        )
        return home + (self._to_frame @ self._field.at_gaussians(common)[..., None])[..., 0]


@torch.no_grad()
def _stretch(avatar: Avatar, field: MeshField) -> Float[Tensor, "V"]:
    """How much any expression, or an opened jaw, changes the edges at each vertex, over lengths.

    Of what carries Gaussians; and what carries the head upon its body is no expression.
    """
    layout, names = avatar.layout, avatar.head.arrays.expression_names
    carries = {layout.slice("expression").start + names.index(k) for k in NECK_SHIFTS if k in names}
    columns = [
        column
        for part in layout.fields
        if part.form == "linear"
        for column in range(layout.size)[layout.slice(part.name)]
        if column not in carries
    ]
    theta = avatar.identity.new_zeros(len(columns) + 2, layout.size)
    theta[torch.arange(len(columns)), columns] = 1
    theta[-2, layout.slice("jaw").start] = _JAW_RAD
    first, second = field.edges.unbind(1)
    vertices = avatar.carrier_vertices(theta)
    edges = vertices[:, second] - vertices[:, first]
    changed = (edges[:-1] - edges[-1:]).norm(dim=-1).amax(0)
    stretch = changed / edges[-1].norm(dim=-1).clamp(min=1e-9)
    return stretch.new_zeros(field.num_vertices).scatter_reduce(0, first, stretch, "amax")
