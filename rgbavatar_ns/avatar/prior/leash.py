"""A leash for Gaussians: where faces move farther than filmed they stay beside their neighbours."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rgbavatar_ns.avatar.avatar import Avatar
from rgbavatar_ns.avatar.prior.mesh_field import MeshField
from rgbavatar_ns.head.arrays import NECK_SHIFTS

_RATE = 0.01
"""Share of the way to its neighbours' mean that a Gaussian goes in a step."""
_STRETCH = 0.3
"""How much an expression stretches or turns the mesh where the leash has its whole strength."""
_SHOWN_ENOUGH, _SHOWN_LITTLE = 0.5, 0.25
"""How far a film has stretched a place, of what can be, that teaches all of it, and that hardly
does: speech stretches a mouth by .2 to .3, a film that smiles, frowns and yawns by .5 to .8."""
_JAW_RAD = 0.3
_ITERATIONS = 30


class Leash:
    """Draws each Gaussian's offset from the mesh towards that of its neighbours. Ours.

    Because frames of a film that hardly moves the mouth do not tell which part of the face a pixel
    belongs to: Gaussians wander by centimetres, and an expression beyond the film tears what they
    paint apart. The offset that they have in common, such as a beard's, stays; so does every one
    where nothing moves, such as in hair, whose depth the head's turn teaches.
    """

    def __init__(self, avatar: Avatar, field: MeshField) -> None:
        self._field = field
        rest = avatar.carrier_vertices(avatar.identity.new_zeros(1, avatar.layout.size))
        self._to_head = avatar.anchors.frames(rest).matrix[0]
        inverse, failed = torch.linalg.inv_ex(self._to_head)
        flat = (failed != 0) | ~inverse.isfinite().flatten(1).all(1)
        self._to_frame = torch.where(flat[:, None, None], torch.zeros_like(inverse), inverse)
        self._flat = flat
        self._columns, self._unit = _motions(avatar)
        self._stretch = _stretch(avatar, field, self._columns, self._unit)

    def share(self, avatar: Avatar) -> Float[Tensor, "N"]:
        """Of the way in a step, for a film of the avatar's range of theta.

        Where a film has stretched the face it has taught what goes with what, also what lies off
        it, such as glasses: there is no leash.
        """
        reach = (avatar.theta_high - avatar.theta_low)[self._columns] / self._unit
        most = self._stretch.amax(0)
        shown = (reach.clamp(0, 1)[:, None] * self._stretch).amax(0) / most.clamp(min=1e-9)
        untaught = (_SHOWN_ENOUGH - shown) / (_SHOWN_ENOUGH - _SHOWN_LITTLE)
        pull = _RATE * (most / _STRETCH).clamp(max=1) * untaught.clamp(0, 1)
        return torch.where(self._flat, 0.0, self._field.at_gaussians(pull[:, None])[:, 0])

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


def _motions(avatar: Avatar) -> tuple[Int[Tensor, "M"], Float[Tensor, "M"]]:
    """Columns of theta that move the face, the jaw's last, and how far they are taken to go.

    What carries the head upon its body is no expression.
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
    columns.append(layout.slice("jaw").start)
    unit = avatar.identity.new_ones(len(columns))
    unit[-1] = _JAW_RAD
    return torch.tensor(columns, device=unit.device), unit


@torch.no_grad()
def _stretch(
    avatar: Avatar, field: MeshField, columns: Int[Tensor, "M"], unit: Float[Tensor, "M"]
) -> Float[Tensor, "M V"]:
    """How much each motion changes the edges at each vertex, over their lengths.

    Of what carries Gaussians.
    """
    count = len(columns)
    theta = avatar.identity.new_zeros(count + 1, avatar.layout.size)
    theta[torch.arange(count, device=unit.device), columns] = unit
    first, second = field.edges.unbind(1)
    vertices = avatar.carrier_vertices(theta)
    edges = vertices[:, second] - vertices[:, first]
    changed = (edges[:-1] - edges[-1:]).norm(dim=-1)
    stretch = changed / edges[-1].norm(dim=-1).clamp(min=1e-9)
    most = stretch.new_zeros(count, field.num_vertices)
    return most.scatter_reduce(1, first.expand(count, -1), stretch, "amax")
