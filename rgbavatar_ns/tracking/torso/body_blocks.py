"""What was seen of a body through some frames, as a file from which a later run goes on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.reading import DamagedFileError, load_arrays
from rgbavatar_ns.tracking.resumable_run import GO_ON, stage_damage_told
from rgbavatar_ns.tracking.torso.cloth_colors import ClothColors
from rgbavatar_ns.tracking.torso.features import FollowedPoints
from rgbavatar_ns.tracking.torso.follow import BodySighting, FollowerState, KeyPicture
from rgbavatar_ns.tracking.torso.outline_motion import OutlinePatch
from rgbavatar_ns.tracking.torso.place import SeenShoulders
from rgbavatar_ns.tracking.torso.rigid_motion import RigidMotion
from rgbavatar_ns.tracking.torso.shape import ShoulderLine
from rgbavatar_ns.tracking.torso.shown import BodyShown

_MOST_BYTES = 1 << 32
_Arrays = Mapping[str, Shaped[np.ndarray, "..."]]


@dataclass(frozen=True)
class BodyBlock:
    """What tracked frames in a row show; positions count all tracked frames."""

    sightings: Sequence[BodySighting]
    shoulders: Sequence[SeenShoulders]
    patches: Sequence[OutlinePatch]
    lines: Sequence[ShoulderLine]
    shown: Sequence[BodyShown]
    state: FollowerState
    """What following the next frames goes on from."""

    def save(self, path: Path) -> None:
        """Write everything to a file of NumPy's."""
        arrays = _sightings_packed(self.sightings) | _state_packed(self.state)
        arrays |= {
            "shoulder_frame": np.array([one.position for one in self.shoulders], np.int64),
            "shoulders_px": np.array([one.shoulders_px for one in self.shoulders]).reshape(
                -1, 2, 2
            ),
            "yaw_rad": np.array([one.yaw_rad for one in self.shoulders], np.float64),
            "patch_frame": np.array([one.position for one in self.patches], np.int64),
            "patch_alpha": np.array([one.alpha for one in self.patches], np.uint8),
            "line_frame": np.array([one.position for one in self.lines], np.int64),
            "line_cm": np.array([one.above_cm for one in self.lines]),
            "shown_frame": np.array([one.position for one in self.shown], np.int64),
            "seen_cm2": np.array([one.seen_cm2 for one in self.shown], np.float64),
            "beside": np.array([one.beside for one in self.shown], np.float64),
        }
        with atomic_write(path, remedy=GO_ON) as partial:
            np.savez(partial, **arrays)

    @classmethod
    def load(cls, path: Path) -> "BodyBlock":
        """What `save` wrote; UserError where the file holds anything else."""
        with stage_damage_told(path, "body that was seen"):
            held = load_arrays(path, _MOST_BYTES)
            rows = zip(held["shoulder_frame"], held["shoulders_px"], held["yaw_rad"])
            shown = zip(held["shown_frame"], held["seen_cm2"], held["beside"])
            return cls(
                _sightings_unpacked(held),
                [SeenShoulders(int(k), px, float(yaw)) for k, px, yaw in rows],
                [OutlinePatch(int(k), a) for k, a in zip(held["patch_frame"], held["patch_alpha"])],
                [ShoulderLine(int(k), cm) for k, cm in zip(held["line_frame"], held["line_cm"])],
                [BodyShown(int(k), float(seen), float(beside)) for k, seen, beside in shown],
                _state_unpacked(held),
            )

    @classmethod
    def joined(cls, blocks: Sequence["BodyBlock"]) -> "BodyBlock":
        """Blocks one after the other."""
        lists = [f.name for f in fields(cls) if f.name != "state"]
        parts = {name: [one for block in blocks for one in getattr(block, name)] for name in lists}
        return cls(**parts, state=blocks[-1].state)


def _sightings_packed(sightings: Sequence[BodySighting]) -> dict[str, np.ndarray]:
    """Plain arrays; frames that chose no points have a count of -1."""
    no_points, no_certainty = np.zeros((0, 2)), np.zeros((0, 2, 2))
    chosen = [no_points if one.chosen_px is None else one.chosen_px for one in sightings]
    certain = [no_certainty if one.certainty is None else one.certainty for one in sightings]
    return {
        "run": np.array([one.run for one in sightings]),
        "background_px": np.array([one.background_px for one in sightings]),
        "covered": np.array([one.covered for one in sightings]),
        "of_first": np.array([one.of_first for one in sightings]),
        "seen": np.array([len(one.seen_px) for one in sightings]),
        "seen_px": np.concatenate([no_points, *(one.seen_px for one in sightings)]),
        "chosen": np.array(
            [-1 if one.chosen_px is None else len(one.chosen_px) for one in sightings]
        ),
        "chosen_px": np.concatenate([no_points, *chosen]),
        "certainty": np.concatenate([no_certainty, *certain]),
    }


def _sightings_unpacked(held: _Arrays) -> list[BodySighting]:
    seen_at, chosen_at = (np.cumsum(held[name].clip(0)) for name in ("seen", "chosen"))
    seen_px = np.split(held["seen_px"], seen_at)[:-1]
    chosen_px = np.split(held["chosen_px"], chosen_at)[:-1]
    certainty = np.split(held["certainty"], chosen_at)[:-1]
    return [
        BodySighting(
            int(held["run"][k]),
            seen_px[k],
            chosen_px[k] if held["chosen"][k] >= 0 else None,
            certainty[k] if held["chosen"][k] >= 0 else None,
            float(held["background_px"][k]),
            float(held["covered"][k]),
            bool(held["of_first"][k]),
        )
        for k in range(len(held["run"]))
    ]


def _state_packed(state: FollowerState) -> dict[str, np.ndarray]:
    """Plain arrays, exact to the bit; without a key picture or colours theirs are missing."""
    arrays = {
        "state_counts": np.array([state.run, state.plain_frames], np.int64),
        "state_turns": np.array([state.start.rotation, state.motion.rotation]),
        "state_shifts_m": np.array([state.start.shift_m, state.motion.shift_m]),
        "near_px": state.near_px,
        "beside_px": state.beside_px,
    }
    if state.key is not None:
        arrays |= _key_packed("key", state.key)
    if state.first is not None and state.first is not state.key:
        arrays |= _key_packed("first", state.first)
    if state.cloth is not None:
        arrays |= {"cloth_places_m": state.cloth.places_m, "cloth_rgb": state.cloth.rgb}
    return arrays


def _state_unpacked(held: _Arrays) -> FollowerState:
    run, plain_frames = held["state_counts"].tolist()
    # In memory of their own, as while following: at odd places of an array, some processors'
    # BLAS multiplies matrices to other last bits.
    turns, shifts_m = held["state_turns"], held["state_shifts_m"]
    start, motion = (RigidMotion(turns[k].copy(), shifts_m[k].copy()) for k in (0, 1))
    key = _key_unpacked("key", held)
    first = _key_unpacked("first", held) or key
    near_px, beside_px = held["near_px"], held["beside_px"]
    if key is not None and len(near_px) != len(key.places_m):
        raise DamagedFileError("its arrays do not fit together")
    cloth = None
    if "cloth_rgb" in held:
        cloth = ClothColors(held["cloth_places_m"], held["cloth_rgb"])
    return FollowerState(run, plain_frames, start, motion, first, key, near_px, beside_px, cloth)


def _key_packed(name: str, key: KeyPicture) -> dict[str, np.ndarray]:
    arrays = {
        "picture": key.body.key,
        "points_px": key.body.points_px,
        "certainty": key.body.certainty,
        "places_m": key.places_m,
        "beside_px": key.background.points_px,
        "beside_certainty": key.background.certainty,
        "covered": np.array(key.covered),
    }
    return {f"{name}_{part}": array for part, array in arrays.items()}


def _key_unpacked(name: str, held: _Arrays) -> KeyPicture | None:
    if f"{name}_picture" not in held:
        return None
    picture = held[f"{name}_picture"]
    body = FollowedPoints(picture, held[f"{name}_points_px"], held[f"{name}_certainty"])
    beside = FollowedPoints(picture, held[f"{name}_beside_px"], held[f"{name}_beside_certainty"])
    return KeyPicture(body, held[f"{name}_places_m"], beside, held[f"{name}_covered"].item())
