"""The head model: theta and identity to posed vertices, for FLAME and the embedded head alike."""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head.arrays import EMBEDDED_HEAD, HeadArrays, flat_directions
from rgbavatar_ns.head.joints import JOINT_FIELDS
from rgbavatar_ns.head.layout import ThetaField, ThetaLayout
from rgbavatar_ns.head.rotations import axis_angle_to_matrix


class HeadModel(nn.Module):
    """A mesh with shape directions and five joints (Li et al. 2017, FLAME, eq. 1-5).

    The arrays are buffers outside of the state dict: `arrays` carries them (`to_state`).
    """

    faces: Int[Tensor, "F 3"]
    uv: Float[Tensor, "VT 2"]
    uv_faces: Int[Tensor, "F 3"]
    _template: Float[Tensor, "3 V"]
    _identity_dirs: Float[Tensor, "I V3"]
    _linear_dirs: Float[Tensor, "E V3"]
    _eyelid_dirs: Float[Tensor, "L V3"]
    _pose_dirs: Float[Tensor, "P V3"]
    _linear_joint_dirs: Float[Tensor, "E 15"]
    _regressor: Float[Tensor, "V 5"]
    _weights: Float[Tensor, "5 V"]

    def __init__(self, arrays: HeadArrays, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.arrays = arrays
        self._parents = [int(parent) for parent in arrays.parents]
        directions = arrays.flat_shapedirs
        eyelids = arrays.eyelid_dirs
        posedirs = arrays.posedirs if arrays.posedirs.any() else arrays.posedirs[..., :0]
        eyelid_dirs = arrays.posedirs[..., :0] if eyelids is None else eyelids
        for name, values in (
            ("_template", arrays.v_template.T),
            ("_identity_dirs", directions[: arrays.num_identity]),
            ("_linear_dirs", directions[arrays.num_identity :]),
            ("_eyelid_dirs", flat_directions(eyelid_dirs)),
            ("_pose_dirs", flat_directions(posedirs)),
            ("_linear_joint_dirs", arrays.joint_directions),
            ("_regressor", arrays.joint_regressor.T),
            ("_weights", arrays.skinning_weights.T),
            ("uv", arrays.uv),
        ):
            # Copied, so that no user of the tensors can change the shared arrays.
            self.register_buffer(name, torch.tensor(values, dtype=dtype), persistent=False)
        for name, index in (("faces", arrays.faces), ("uv_faces", arrays.uv_faces)):
            self.register_buffer(name, torch.tensor(index, dtype=torch.int64), persistent=False)
        self.layout = layout_of(arrays)
        self._remembered: _Person | None = None

    @classmethod
    def embedded(cls, dtype: torch.dtype = torch.float32, name: str = EMBEDDED_HEAD) -> "HeadModel":
        """The CC0 MakeHuman head that ships with the package, or the bust (`EMBEDDED_BUST`)."""
        return cls(HeadArrays.embedded(name), dtype)

    @property
    def num_identity(self) -> int:
        """How many identity coefficients there are."""
        return self.arrays.num_identity

    def forward(
        self,
        theta: Float[Tensor, "*batch H"],
        identity: Float[Tensor, "I"] | Float[Tensor, "*batch I"] | None = None,
        only: Int[Tensor, "N"] | None = None,
    ) -> Float[Tensor, "*batch V 3"] | Float[Tensor, "*batch N 3"]:
        """Vertices in world space in metres; all zero gives `v_template` to the bit.

        All of them, or `only` some, which takes a fraction of the time.
        The global rotation turns about the root joint, then the translation is added. Eyelid
        offsets are added before skinning and after the joints are found, as in the release, so
        that a blink turns with the head and shifts no joint; metrical-tracker adds them after
        skinning, which is the same for its frames, whose root and neck do not turn. Raises
        UserError where theta or identity have another size.
        """
        batch = theta.shape[:-1]
        parts = self.layout.split(theta.reshape(-1, theta.shape[-1]))
        person, person_joints = self._person(identity, batch)
        expressed = _some(self._linear_dirs, only)
        shaped = torch.addmm(_some(person, only), parts["expression"], expressed)
        shaped = shaped.unflatten(-1, (3, -1))
        turns, moves = self._bones(parts, person_joints)
        if "eyelids" in parts:
            shaped = shaped + (parts["eyelids"] @ _some(self._eyelid_dirs, only)).unflatten(
                -1, (3, -1)
            )
        if len(self._pose_dirs):
            correctives = turns[:, 1:].flatten(1) @ _some(self._pose_dirs, only)
            shaped = shaped + correctives.unflatten(-1, (3, -1))
        # Linear blend skinning moves each vertex by A x + s.
        weights = self._weights if only is None else self._weights[:, only]
        x, y, z, moved = (moves @ weights).unbind(2)
        posed = shaped + parts["translation"][..., None] + moved
        for row, along in zip((x, y, z), shaped[:, None].unbind(2)):
            posed = torch.addcmul(posed, row, along)
        vertices = posed.mT
        return vertices.reshape(*batch, *vertices.shape[1:])

    def joint_transforms(
        self,
        theta: Float[Tensor, "*batch H"],
        identity: Float[Tensor, "I"] | Float[Tensor, "*batch I"] | None = None,
    ) -> Float[Tensor, "*batch 5 4 4"]:
        """What each joint does to a point of the head at rest, in the order of `joints`.

        Blended by the skinning weights they carry what is shaped already to where `forward` has it,
        translation included; all zero theta gives identities to the bit. Raises as `forward`.
        """
        batch = theta.shape[:-1]
        parts = self.layout.split(theta.reshape(-1, theta.shape[-1]))
        _, moves = self._bones(parts, self._person(identity, batch)[1])
        moves = F.pad(moves.movedim(-1, 1), (0, 0, 0, 1))
        shift = F.pad(parts["translation"][:, None, :, None], (3, 0, 0, 1))
        transforms = torch.eye(4, dtype=moves.dtype, device=moves.device) + moves + shift
        return transforms.reshape(*batch, 5, 4, 4)

    def joints(self, identity: Float[Tensor, "I"] | None = None) -> Float[Tensor, "5 3"]:
        """Joints of the neutral head at rest: root, neck, jaw, left eye, right eye, metres."""
        _, joints = self._person(identity, torch.Size())
        return joints.reshape(3, 5).mT

    def remembered(self, identity: Float[Tensor, "I"]) -> tuple[Tensor, Tensor]:
        """The neutral head's vertices and joints that calls with this steady identity share."""
        return self._person(identity, torch.Size())

    def loop_arrays(self, identity: Float[Tensor, "I"]) -> dict[str, Any]:
        """What `forward` computes with, of one identity, for loops that do the same.

        By the names of `kernels.PosingParameters`.
        """
        vertices, joints = self._person(identity, torch.Size())
        return {
            "rest": vertices.unflatten(-1, (3, -1))[0],
            "directions": torch.cat([self._linear_dirs, self._eyelid_dirs, self._pose_dirs]),
            "joints": joints.unflatten(-1, (3, 5))[0],
            "joint_directions": self._linear_joint_dirs,
            "skinning": self._weights,
            "parents": tuple(self._parents),
            "turns": tuple(self.layout.slice(name).start for name in JOINT_FIELDS),
        }

    def _person(
        self, identity: Float[Tensor, "*_"] | None, batch: torch.Size
    ) -> tuple[Float[Tensor, "#B V3"], Float[Tensor, "#B 15"]]:
        """Vertices and joints of the neutral head of an identity.

        One that needs no gradient is remembered, since nearly all calls are about one subject.
        """
        steady = identity if _is_steady(identity) else None
        known = self._remembered
        if steady is not None and known is not None and known.is_of(steady, self._template):
            return known.vertices, known.joints
        flat = self._flat_identity(identity, batch)
        vertices = self._template.flatten() + flat @ self._identity_dirs
        joints = (vertices.unflatten(-1, (3, -1)) @ self._regressor).flatten(1)
        if steady is not None:
            version = steady._version
            self._remembered = _Person(steady, version, self._template, vertices, joints)
        return vertices, joints

    def _flat_identity(
        self, identity: Float[Tensor, "*_"] | None, batch: torch.Size
    ) -> Float[Tensor, "#B I"]:
        if identity is None:
            return self._template.new_zeros(1, self.num_identity)
        if identity.shape[-1] != self.num_identity:
            raise UserError(
                f"The identity has {identity.shape[-1]} numbers, but the head model "
                f"'{self.arrays.name}' has {self.num_identity}.",
                "Use the identity that was fitted with this head model.",
            )
        if identity.ndim == 1:
            return identity[None]
        return identity.expand(*batch, self.num_identity).reshape(-1, self.num_identity)

    def _bones(
        self, parts: dict[str, Tensor], person_joints: Float[Tensor, "#B 15"]
    ) -> tuple[Float[Tensor, "B 5 3 3"], Float[Tensor, "B 3 4 5"]]:
        """R - I of each joint's own turn, and how all that turns it moves a point: by A x + s.

        Everything is kept as a difference from rest, so that no rotation means exactly no motion.
        """
        joints = torch.addmm(person_joints, parts["expression"], self._linear_joint_dirs)
        joints = joints.unflatten(-1, (3, 5)).mT
        turns = axis_angle_to_matrix(torch.stack([parts[name] for name in JOINT_FIELDS], dim=1))
        turns = turns - torch.eye(3, dtype=turns.dtype, device=turns.device)
        # About its joint j alone, a bone moves x by T (x - j).
        alone = torch.cat([turns, -(turns @ joints[..., None])], -1).unbind(1)
        moves: list[Tensor] = []
        for local, parent in zip(alone, self._parents):
            if parent < 0:
                moves.append(local)
                continue
            above = moves[parent]
            # First the bone, then all above it: m + M(x + m) = M(x) + m + A m.
            moves.append(torch.baddbmm(above + local, above[..., :3], local))
        return turns, torch.stack(moves, -1)


@dataclass(frozen=True)
class _Person:
    """A neutral head, and of which identity and template it is."""

    identity: Tensor
    version: int
    template: Tensor
    vertices: Float[Tensor, "1 V3"]
    joints: Float[Tensor, "1 15"]

    def is_of(self, identity: Tensor, template: Tensor) -> bool:
        """Whether this is the very tensor, unchanged since, of the head where it is now."""
        same = identity is self.identity and identity._version == self.version
        return same and template is self.template


def _is_steady(identity: Tensor | None) -> bool:
    """Whether what follows from one identity can be used again, in any mode of autograd."""
    if identity is None or identity.ndim != 1 or identity.requires_grad:
        return False
    return not (identity.is_inference() or torch.is_inference_mode_enabled())


def _some(
    directions: Float[Tensor, "C V3"], vertices: Int[Tensor, "N"] | None
) -> Float[Tensor, "C _"]:
    """Flat directions of these vertices; None: of all."""
    if vertices is None:
        return directions
    return directions.unflatten(-1, (3, -1))[..., vertices].flatten(1)


def layout_of(arrays: HeadArrays) -> ThetaLayout:
    """What the numbers of this head's theta mean."""
    fields = [ThetaField("expression", arrays.num_expressions, "linear")]
    fields += [ThetaField(name, 3, "axis_angle") for name in JOINT_FIELDS]
    if arrays.eyelid_dirs is not None:
        fields.append(ThetaField("eyelids", 2, "linear"))
    fields.append(ThetaField("translation", 3, "translation"))
    return ThetaLayout(tuple(fields))
