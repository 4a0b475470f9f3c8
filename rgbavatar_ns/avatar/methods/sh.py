"""Colours that depend on where they are seen from: real spherical harmonics up to degree 3.

Order, signs and constants are those of 3D Gaussian splatting (Kerbl et al. 2023, `sh_utils.py` and
`forward.cu`), so that coefficients mean the same in its files: degree after degree, order m from -l
to l, with (-1)^m (Condon-Shortley). Directions go from the camera to the Gaussian.
"""

import functools
import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from rgbavatar_ns.avatar.model.blendshapes import COLOR_SCALE
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import PinholeCameras, harmonic_colors

MAX_DEGREE = 3
_LINEAR = 0.4886025119029199
_SQUARE = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_CUBE = (
    *(0.5900435899266435, 2.890611442640554, 0.4570457994644658),
    *(0.3731763325901154, 1.445305721320277),
)


def num_coefficients(degree: int) -> int:
    """How many coefficients a colour channel has; raises ValueError beyond degree 0 to 3."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree is {degree}. Pass 0 to {MAX_DEGREE}.")
    return (degree + 1) ** 2


class ShownDegree:
    """The degree up to which a method shows its harmonics so far, kept as a buffer of the method.

    Read where it changed only, so that a training step does not wait for a GPU.

    Args:
        owner: the method, which gets the buffer.
        name: of the buffer, of kind int64 and shape [].
        most: the degree of the stored coefficients.
    """

    def __init__(self, owner: nn.Module, name: str, most: int) -> None:
        owner.register_buffer(name, torch.zeros((), dtype=torch.int64))
        owner.register_load_state_dict_post_hook(
            lambda module, _: _require_degree(int(getattr(module, name)), most)
        )
        self._owner, self._name, self._most = owner, name, most
        self._read: tuple[Tensor, int, int] | None = None

    @property
    def now(self) -> int:
        """The degree."""
        buffer = getattr(self._owner, self._name)
        if self._read is None or self._read[0] is not buffer or self._read[1] != buffer._version:
            self._read = (buffer, buffer._version, int(buffer))
        return self._read[2]

    def set(self, degree: int) -> None:
        """Show as many degrees from now on."""
        if self.now != degree:
            getattr(self._owner, self._name).fill_(degree)

    def raise_by(self, step: int, every: int) -> None:
        """Show what is due after step `step`, as releases do it whose first step is 1.

        They raise the degree by one, up to the last, at the beginning of each step that `every`
        divides.
        """
        self.set(min((step + 2) // every, self._most))


def _require_degree(degree: int, most: int) -> None:
    """Raise UserError for a degree, as a file may have it, that its coefficients have not."""
    if not 0 <= degree <= most:
        raise UserError(
            f"The avatar shows harmonics up to degree {degree}, and has those up to {most}.",
            "Use another copy of the avatar or checkpoint.",
        )


def view_directions(
    means: Float[Tensor, "#B N 3"], cameras: PinholeCameras
) -> Float[Tensor, "#B N 3"]:
    """Unit vectors from each image's camera to the Gaussians, in the world; cameras are 1 or B."""
    rotation, shift = cameras.world_to_camera[:, :3, :3], cameras.world_to_camera[:, :3, 3:]
    centres = -(rotation.mT @ shift).mT
    return F.normalize(means - centres, dim=-1)


def directions_in_frames(
    directions: Float[Tensor, "#B N 3"], rotations: Float[Tensor, "#B N 3 3"]
) -> Float[Tensor, "B N 3"]:
    """R^-1 d: what turned colours show along d, unturned ones show along these directions.

    The cheap way to turn colours with what carries them: 9 products a Gaussian, `rotate_sh` 768.
    """
    return (rotations * directions[..., :, None]).sum(-2)


def sh_basis(directions: Float[Tensor, "*n 3"], degree: int) -> Float[Tensor, "*n C"]:
    """Values of the (degree + 1)^2 harmonics along unit vectors."""
    num_coefficients(degree)
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, COLOR_SCALE)]
    if degree > 0:
        values += [-_LINEAR * y, _LINEAR * z, -_LINEAR * x]
    xx, yy, zz = x * x, y * y, z * z
    xy, both, around = x * y, xx + yy, xx - yy
    if degree > 1:
        a, b, c = _SQUARE
        values += [a * xy, -a * (y * z), b * (2 * zz - both), -a * (x * z), c * around]
    if degree > 2:
        a, b, c, d, e = _CUBE
        flat = 4 * zz - both
        values += [-a * y * (3 * xx - yy), b * xy * z, -c * y * flat, d * z * (2 * zz - 3 * both)]
        values += [-c * x * flat, e * z * around, -a * x * (xx - 3 * yy)]
    return torch.stack(values, -1)


def sh_colors(
    coefficients: Float[Tensor, "N C 3"] | Float[Tensor, "#B N C 3"],
    directions: Float[Tensor, "B N 3"],
    degree: int,
) -> Float[Tensor, "B N 3"]:
    """Colours .5 + sum Y_k(d) c_k, not below 0 (as 3D Gaussian splatting), seen along unit vectors.

    Of more coefficients than the degree has, the first ones count. Raises ValueError for fewer.
    """
    count = num_coefficients(degree)
    if coefficients.shape[-2] < count:
        raise ValueError(
            f"{coefficients.shape[-2]} coefficients for degree {degree}. Pass {count} or more."
        )
    used = coefficients[..., :count, :]
    used = used if used.ndim == 4 else used[None]
    if degree == 0:
        flat = COLOR_SCALE * used[..., 0, :] + 0.5
        return flat.clamp(min=0).expand(len(directions), -1, -1)
    found = harmonic_colors(used, directions)
    if found is not None:
        return found
    shared = used[0] if len(used) == 1 else used
    equation = "bnc,ncx->bnx" if shared.ndim == 3 else "bnc,bncx->bnx"
    colors = torch.einsum(equation, sh_basis(directions, degree), shared)
    return (colors + 0.5).clamp(min=0)


def shown_colors(
    flat: Float[Tensor, "N 1 3"],
    rest: Float[Tensor, "N C 3"],
    shown: ShownDegree,
    means: Float[Tensor, "B N 3"],
    cameras: PinholeCameras | None,
    rotations: Float[Tensor, "B N 3 3"] | None = None,
) -> Float[Tensor, "#B N 3"]:
    """Colours as the cameras see them up to the degree that is shown; without cameras, degree 0.

    The coefficients are `flat` of degree 0 and `rest` of the others; `rotations` turn the colours.
    """
    degree = 0 if cameras is None else shown.now
    if cameras is None or degree == 0:
        return sh_colors(flat, means[:1], 0)
    directions = view_directions(means, cameras)
    if rotations is not None:
        directions = directions_in_frames(directions, rotations)
    used = rest[:, : num_coefficients(degree) - 1]
    return sh_colors(torch.cat([flat, used], 1), directions, degree)


def rotate_sh(
    coefficients: Float[Tensor, "*#n C 3"], rotations: Float[Tensor, "*#n 3 3"]
) -> Float[Tensor, "*n C 3"]:
    """Coefficients of the colours turned by proper rotations: along d they show what was at R^-1 d.

    For what needs coefficients themselves, as files of Gaussians do: each harmonic, turned, is
    projected upon all of its degree by a quadrature that is exact for their products. Raises
    ValueError unless there are 1, 4, 9 or 16 coefficients.
    """
    count = coefficients.shape[-2]
    degree = math.isqrt(count) - 1
    if num_coefficients(max(degree, 0)) != count:
        raise ValueError(f"{count} coefficients a colour. Pass 1, 4, 9 or 16.")
    points, weights = (part.to(coefficients) for part in _quadrature())
    # Row k: R^-1 d_k.
    turned = sh_basis(points @ rotations, degree)
    projection = sh_basis(points, degree).mT * weights
    return (projection @ turned) @ coefficients


@functools.cache
def _quadrature() -> tuple[Float[Tensor, "Q 3"], Float[Tensor, "Q"]]:
    """Points and weights on the unit sphere, exact for polynomials up to degree 7: Gauss-Legendre.

    Of products of two harmonics of degree 3 the degree is 6.
    """
    heights, weights = np.polynomial.legendre.leggauss(4)
    around = 2 * math.pi * np.arange(8) / 8
    z, angle = (part.ravel() for part in np.meshgrid(heights, around, indexing="ij"))
    radius = np.sqrt(1 - z**2)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
    with torch.inference_mode(False):
        return torch.from_numpy(points), torch.from_numpy(np.repeat(weights * math.pi / 4, 8))
