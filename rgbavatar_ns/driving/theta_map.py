"""Another head's theta in the avatar's layout: by name, by ARKit's names, or by what it moves."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.errors import UserError, first_few
from rgbavatar_ns.head import HeadArrays, ThetaLayout
from rgbavatar_ns.head.arkit import arkit_map, head_carrier, speaks_arkit
from rgbavatar_ns.head.expression_bases import ExpressionFit, expression_fit
from rgbavatar_ns.head.layout import CARRIER_FIELDS
from rgbavatar_ns.head.rotations import axis_angle_to_matrix, matrix_to_axis_angle


@dataclass(frozen=True)
class ThetaNames:
    """What each number of theta is called."""

    layout: ThetaLayout
    expression_names: tuple[str, ...]

    @classmethod
    def of(cls, layout: ThetaLayout, arrays: HeadArrays) -> "ThetaNames":
        """The names of a head model's theta."""
        return cls(layout, arrays.expression_names)

    @property
    def numbers(self) -> tuple[str, ...]:
        """A name for each number; the expressions' own, and field and place for the others."""
        names: list[str] = []
        for part in self.layout.fields:
            if part.name == "expression":
                names += self.expression_names
            else:
                names += [f"{part.name}[{i}]" for i in range(part.size)]
        return tuple(names)

    @property
    def has_shoulders(self) -> bool:
        """Whether the root carries a body and the neck the head upon it."""
        return head_carrier(self.expression_names) == "neck"


@dataclass(frozen=True)
class MappedTheta:
    """A driver's theta in the avatar's layout."""

    theta: Float[Tensor, "F H"]
    known: Bool[Tensor, "H"]
    """Which of the avatar's numbers the driver has; the others are 0."""
    unmapped: tuple[str, ...] = ()
    """The driver's numbers that the avatar does not know."""
    missing: tuple[str, ...] = ()
    """The avatar's numbers that the driver does not know."""
    told: str = ""
    """What else the user should know of the way; empty where numbers go by their names."""


ThetaMap = Callable[[Float[Tensor, "F G"]], MappedTheta]
"""From a driver's theta to the avatar's."""


def theta_map(layout: ThetaLayout, arrays: HeadArrays, avatar: AvatarMethod) -> ThetaMap:
    """The way from the theta of a driver's head (`layout`, `arrays`) to the avatar's.

    By name where a name is shared, nameless expressions of another FLAME by what they move
    (`expression_fit`); from a head with ARKit's names to any other head through ARKit's
    coefficients (`AvatarMethod.arkit`). Raises UserError where neither is possible.
    """
    driver = ThetaNames.of(layout, arrays)
    own = ThetaNames.of(avatar.layout, avatar.head.arrays)
    if set(driver.expression_names) & set(own.expression_names) or not speaks_arkit(arrays):
        fit = expression_fit(arrays, avatar.head.arrays)
        told = "" if fit is None else _told(fit, arrays.name, avatar.head.arrays.name)
        return NamedMap(driver, own, fit, told)
    theirs, ours = arkit_map(arrays), avatar.arkit

    def by_arkit(theta: Float[Tensor, "F G"]) -> MappedTheta:
        return arkit_theta(avatar, theirs.coefficients(theta), theirs.head_rotation(theta))

    assert ours.layout == avatar.layout
    return by_arkit


def arkit_theta(
    avatar: AvatarMethod,
    coefficients: Float[Tensor, "F 52"],
    head_rotation: Float[Tensor, "F 3"] | None,
) -> MappedTheta:
    """ARKit coefficients and the head's turn as the avatar's theta; what they do not tell is 0."""
    known = torch.as_tensor(avatar.arkit.theta_per_unit).abs().sum(0) > 0
    if head_rotation is not None:
        known[avatar.layout.slice(avatar.arkit.turns)] = True
    return MappedTheta(avatar.arkit.theta(coefficients, head_rotation), known)


class NamedMap:
    """Theta of one head model in the layout of another, number by number by its name.

    Between a head and one upon shoulders the head's whole turn goes to the joint that carries it;
    what a head alone says of place and turn is nothing that shoulders have to follow. Where names
    mean something else in each, `fit` makes all expressions of all. Raises UserError where not a
    single expression has a name that the avatar knows.
    """

    def __init__(
        self,
        driver: ThetaNames,
        avatar: ThetaNames,
        fit: ExpressionFit | None = None,
        told: str = "",
    ) -> None:
        _require_a_shared_name(driver, avatar)
        self._driver, self._avatar, self._told = driver.layout, avatar.layout, told
        self._table = None if fit is None else torch.from_numpy(fit.table)
        place_of = {name: place for place, name in enumerate(driver.numbers)}
        wanted = avatar.numbers
        named = torch.tensor([name in place_of for name in wanted])
        self._to = torch.nonzero(named)[:, 0]
        self._from = torch.tensor([place_of[name] for name in wanted if name in place_of])
        known, by_driver = set(wanted), set(place_of)
        if fit is not None:
            named[avatar.layout.slice("expression")] = True
            known |= set(driver.expression_names)
            by_driver |= set(avatar.expression_names)
        self._unmapped = tuple(name for name in driver.numbers if name not in known)
        self._missing = tuple(name for name in wanted if name not in by_driver)
        self._known, self._carrier = named, None
        if driver.has_shoulders != avatar.has_shoulders:
            self._carrier, other = (
                reversed(CARRIER_FIELDS) if avatar.has_shoulders else CARRIER_FIELDS
            )
            self._stays = [avatar.layout.slice(other)]
            if avatar.has_shoulders:
                for name in ("rotation", "translation"):
                    self._known[avatar.layout.slice(name)] = False
                    self._stays.append(avatar.layout.slice(name))

    def __call__(self, theta: Float[Tensor, "F G"]) -> MappedTheta:
        """Each frame in the avatar's layout; raises UserError where theta has another size."""
        size = self._driver.size
        if theta.shape[-1] != size:
            raise UserError(
                f"The driver's theta has {theta.shape[-1]} numbers, its layout {size}.",
                "Write the driver's dataset again.",
            )
        result = theta.new_zeros(len(theta), self._avatar.size)
        result[:, self._to] = theta[:, self._from]
        if self._table is not None:
            expression = theta[:, self._driver.slice("expression")]
            result[:, self._avatar.slice("expression")] = expression @ self._table.to(theta)
        if self._carrier is not None:
            parts = self._driver.split(theta)
            root, neck = (axis_angle_to_matrix(parts[name]) for name in CARRIER_FIELDS)
            result[:, self._avatar.slice(self._carrier)] = matrix_to_axis_angle(root @ neck)
            for numbers in self._stays:
                result[:, numbers] = 0
        return MappedTheta(result, self._known, self._unmapped, self._missing, self._told)


def _told(fit: ExpressionFit, driver: str, avatar: str) -> str:
    return (
        f"the driver's expressions are those of {driver}, the avatar's of {avatar}: they are "
        f"fitted, {100 * fit.left_over:.0f} % of their motion is left out"
    )


def _require_a_shared_name(driver: ThetaNames, avatar: ThetaNames) -> None:
    if not set(driver.expression_names) & set(avatar.expression_names):
        raise UserError(
            "The driver has no expression that the avatar knows: the driver's are "
            f"{first_few(driver.expression_names, 4)}, the avatar's "
            f"{first_few(avatar.expression_names, 4)}.",
            "Track the driver's video with the avatar's head model.",
        )
