"""Find how FaceMesh's points follow the embedded head: by looking at renders whose truth is known.

    python scripts/build_landmark_response.py [--people 300]

writes `rgbavatar_ns/head/assets/facemesh_response.npz`. People of the procedural subject's kind,
every second one mirrored and half of them with glasses, speak, turn, and make faces at random;
for each FaceMesh point the difference between where it is found and where its place on the mesh
is seen is explained, in the skull's frame, by `LandmarkResponse`'s terms: a robust ridge regression
whose priors say how many millimetres a term may be expected to do. What the response leaves of a
performance by a person on whom it was not measured is the points' noise: its principal components
are stored too. Seeds begin at 100: the benchmarks' people are others. Takes about an hour, two
gigabytes of memory and mediapipe. (Left out, 30 people leave .81 px an axis, 120 .68, 230
.68, 300 .67 of 1.54: more people would not help.)
"""

import argparse
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from rgbavatar_ns.files import atomic_write
from rgbavatar_ns.head import HeadModel
from rgbavatar_ns.head.landmarks import RESPONSE_FILE, UNSURE_M, facemesh_landmarks
from rgbavatar_ns.synthetic import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson
from rgbavatar_ns.synthetic.performer.performance import perform
from rgbavatar_ns.tracking.face.detector import (
    IRIS_CENTERS,
    FaceLandmarker,
    face_height_px,
    upright_turn,
)
from rgbavatar_ns.tracking.fit.landmark_head import LandmarkHead

FIRST_SEED = 100
ACTED, MADE = 30, 40
"""Frames of each person: from a performance, and faces made at random."""
# What a term may be expected to do, metres, at its usual size: constant, view's five, each
# expression, jaw, both angles of the gaze, each identity component.
USUAL_SIZE = {"rest": 1.0, "view": (0.2, 0.15, 0.06, 0.04, 0.05), "expression": 0.2}
USUAL_SIZE |= {"jaw_open": 0.12, "gaze": (0.1, 0.15), "identity": 0.6}
EXPECTED_M = {"rest": 4e-3, "view": 1.5e-3, "expression": 1.2e-3}
EXPECTED_M |= {"jaw_open": 1.5e-3, "gaze": 7e-4, "identity": 1.2e-3}
# More than a point's own noise: the pictures of one person err together.
NOISE_PX = 2.5
OUTLIER_PX = 3.0
# Shares of the face's height: what a point errs by itself, and the most that one point tells.
# (.001 to .004 were tried: the smaller, the better the head's turn, and from .002 on the better a
# real speaker's avatar; expressions are best at .002.)
OWN_SHARE, MOST_SHARE = 0.0015, 0.04
# An iris between open lids errs by itself: where lids close FaceMesh guesses, and its guesses would
# make all irises look unsure. (.0018 to .0035 give the same gaze.)
IRIS_OWN_SHARE = 0.0025
# Of performances alone: faces made at random are harder than usual ones.
NOISE_MODES = 48
# Pictures that are off by more than this times the median count less and less.
USUAL_TIMES = 1.3


@dataclass(frozen=True)
class Observation:
    """One picture: terms [K]; per point image derivative [L, 2, 3] and what is left [L, 2], px.

    `acted` is of a performance, the others' faces are made at random; `to_shares` [2, 2] takes what
    is left to the upright face, in shares of its height.
    """

    person: int
    acted: bool
    terms: np.ndarray
    derivative: np.ndarray
    residual_px: np.ndarray
    to_shares: np.ndarray


class Mirror:
    """Theta and identity of the mirrored person; the embedded head is symmetric."""

    def __init__(self, head: HeadModel) -> None:
        arrays, self.layout = head.arrays, head.layout
        flip = np.array([-1.0, 1.0, 1.0])
        partner = np.asarray(KDTree(arrays.v_template).query(arrays.v_template * flip)[1])
        dirs = arrays.shapedirs[..., : arrays.num_identity].astype(np.float64)
        overlap = (dirs * (dirs[partner] * flip[:, None])).sum((0, 1))
        self.parity = np.sign(overlap)
        names = arrays.expression_names
        swapped = {"Left": "Right", "Right": "Left"}
        self.expressions = [
            names.index(name.removesuffix(side) + other) if name.endswith(side) else place
            for place, name in enumerate(names)
            for side, other in [next((p for p in swapped.items() if name.endswith(p[0])), ("", ""))]
        ]

    def theta(self, theta: np.ndarray) -> np.ndarray:
        """[F, H] -> [F, H]."""
        parts = {
            field.name: theta[:, self.layout.slice(field.name)] for field in self.layout.fields
        }
        turned = parts | {name: parts[name] * [1, -1, -1] for name in ("rotation", "neck", "jaw")}
        turned["left_eye"] = parts["right_eye"] * [1, -1, -1]
        turned["right_eye"] = parts["left_eye"] * [1, -1, -1]
        turned["translation"] = parts["translation"] * [-1, 1, 1]
        turned["expression"] = parts["expression"][:, self.expressions]
        result = np.empty_like(theta)
        for name, values in turned.items():
            result[:, self.layout.slice(name)] = values
        return result


def made_faces(head: HeadModel, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random combinations of expressions, jaw, gaze and turns as theta [F, H]."""
    layout, names = head.layout, head.arrays.expression_names
    usable = [k for k, name in enumerate(names) if not name.startswith(("eyeLook", "jaw"))]
    theta = np.zeros((count, layout.size))
    for row in theta:
        expression = np.zeros(len(names))
        for chosen in rng.choice(usable, size=rng.integers(1, 7), replace=False):
            expression[chosen] = rng.uniform(0.3, 1.0)
            for side, other in (("Left", "Right"), ("Right", "Left")):
                if names[chosen].endswith(side) and rng.uniform() < 0.7:
                    partner = names.index(names[chosen].removesuffix(side) + other)
                    expression[partner] = expression[chosen]
        row[layout.slice("expression")] = expression
        row[layout.slice("jaw").start] = rng.choice([0.0, rng.uniform(0, 0.33)])
        gaze = rng.uniform([-0.12, -0.28], [0.15, 0.28])
        for name, vergence in (("left_eye", -0.02), ("right_eye", 0.02)):
            first = layout.slice(name).start
            row[first : first + 2] = np.add(gaze, (0.0, vergence))
        row[layout.slice("neck")] = np.radians(rng.normal(size=3) * [9, 13, 6])
        row[layout.slice("translation")] = rng.normal(size=3) * 0.004
    return theta


def seen(seed: int) -> tuple[DemoPerson, np.ndarray, np.ndarray, np.ndarray]:
    """A person; where a face was found theta [F, H], FaceMesh's points [F, 478, 2], acted [F]."""
    config = DemoConfig(
        num_frames=8 * ACTED, seed=seed, glasses=seed % 4 < 2, supersampling=1, frames_per_second=12
    )
    person = DemoPerson.of(config)
    head, rng = person.head, np.random.default_rng(seed)
    script = perform(head.layout, head.arrays.expression_names, 8 * ACTED, 60, 12.0, seed)
    theta = np.concatenate([script[::8], made_faces(head, MADE, rng)])
    mirrored, room = seed % 2 == 1, rng.uniform(60, 190, 3)
    kept, points = [], []
    with closing(FaceLandmarker()) as landmarker:
        for number, image in enumerate(person.draw(torch.from_numpy(theta).float())):
            alpha = image[..., 3:] / 255
            picture = (image[..., :3] * alpha + room * (1 - alpha)).round().astype(np.uint8)
            picture = np.ascontiguousarray(picture[:, ::-1]) if mirrored else picture
            landmarker(picture)  # the next call looks where this one found the face
            found = landmarker(picture)
            if found is not None:
                kept.append(number)
                points.append(found)
    theta = Mirror(head).theta(theta[kept]) if mirrored else theta[kept]
    return person, theta, np.array(points), np.array(kept) < ACTED


def response_terms(
    landmarks: LandmarkHead, theta: np.ndarray, identity: np.ndarray, eye_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What a response is linear in, in one pose, and what turns it into the world [L, 3, 3].

    Terms [K]: 1, then `LandmarkResponse`'s other factors in its order.
    """
    view = landmarks._view(theta, landmarks._coefficients(theta, identity), eye_m)
    expression = theta[landmarks.layout.slice("expression")]
    terms = [np.ones(1), view.signals[:5], expression, view.signals[5:], identity]
    return np.concatenate(terms), landmarks.skinning(view.chain)


def observations(landmarks: LandmarkHead, index: np.ndarray, seeds: range) -> Iterator[Observation]:
    """Every picture of every person."""
    for seed in seeds:
        person, thetas, found, acted = seen(seed)
        identity = person.identity.double().numpy()
        if seed % 2 == 1:
            identity = identity * Mirror(person.head).parity
        camera = person.camera
        eye = np.array([0.0, camera.height_m, camera.distance_m])
        print(f"person {seed}: {len(thetas)} of {ACTED + MADE} pictures", flush=True)
        for theta, points_px, is_acted in zip(thetas, found, acted):
            terms, turned = response_terms(landmarks, theta, identity, eye)
            away = landmarks.points(theta, identity, eye) - eye
            across = camera.focal_px / -away[:, 2]
            image = np.zeros((len(away), 2, 3))
            image[:, 0, 0], image[:, 1, 1] = across, -across
            image[:, :, 2] = image[:, [0, 1], [0, 1]] * away[:, :2] / -away[:, 2:]
            expected = away[:, :2] * [1, -1] * across[:, None] + camera.size / 2
            yield Observation(
                seed,
                is_acted,
                terms,
                (image @ turned).astype(np.float32),
                points_px[index] - expected,
                upright_turn(points_px) / face_height_px(points_px),
            )


def regress(
    derivative: np.ndarray, terms: np.ndarray, residual_px: np.ndarray, person: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One point's offsets a unit of each (scaled) term [K, 3]; outliers count less and less.

    Also what is left [F, 2] of each person by a regression from all others.
    """
    rows = np.einsum("fac,fk->fakc", derivative, terms).reshape(2 * len(terms), -1)
    wanted, weight = residual_px.reshape(-1), np.ones(residual_px.size)
    weighted, normal, pull = rows, np.eye(rows.shape[1]), np.zeros(rows.shape[1])
    solution = np.zeros(rows.shape[1])
    for _ in range(3):
        weighted = rows * weight[:, None] / NOISE_PX**2
        normal = weighted.T @ rows + np.eye(rows.shape[1])
        pull = weighted.T @ wanted
        solution = np.linalg.solve(normal, pull)
        off = np.linalg.norm((wanted - rows @ solution).reshape(-1, 2), axis=1)
        weight = np.repeat(1 / (1 + (off / OUTLIER_PX) ** 2) ** 2, 2)
    left = np.empty_like(wanted)
    for one in np.unique(person):
        own = np.repeat(person == one, 2)
        others = normal - weighted[own].T @ rows[own]
        elsewhere = np.linalg.solve(others, pull - weighted[own].T @ wanted[own])
        left[own] = wanted[own] - rows[own] @ elsewhere
    return solution.reshape(-1, 3), left.reshape(-1, 2)


def noise_modes(left: np.ndarray) -> np.ndarray:
    """Principal components [L, 2, K] of errors [F, L, 2] beyond what each point errs by itself."""
    errors = left.clip(-MOST_SHARE, MOST_SHARE).reshape(len(left), -1)
    off = np.sqrt((errors**2).mean(1))
    weight = 1 / (1 + (off / (USUAL_TIMES * np.median(off))) ** 2) ** 2
    variance, directions = np.linalg.eigh((errors * weight[:, None]).T @ errors / weight.sum())
    strength = np.sqrt(np.maximum(variance[::-1][:NOISE_MODES] - OWN_SHARE**2, 0))
    modes = directions[:, ::-1][:, :NOISE_MODES] * strength
    return modes.reshape(*left.shape[1:], -1)


def build(people: int) -> dict[str, np.ndarray]:
    """The asset's arrays."""
    head = HeadModel.embedded(dtype=torch.float64)
    marks = facemesh_landmarks()
    corners = head.arrays.faces[marks.triangle].astype(np.int64)
    landmarks = LandmarkHead(head, corners, marks.barycentric)
    found = list(
        observations(landmarks, marks.facemesh_index, range(FIRST_SEED, FIRST_SEED + people))
    )
    counts = {"rest": 1, "view": 5, "expression": head.arrays.num_expressions}
    counts |= {"jaw_open": 1, "gaze": 2, "identity": head.arrays.num_identity}
    scale = np.concatenate(
        [
            np.full(count, EXPECTED_M[name]) / np.broadcast_to(USUAL_SIZE[name], count)
            for name, count in counts.items()
        ]
    )
    terms = np.array([one.terms for one in found]) * scale
    derivative = np.array([one.derivative for one in found])
    acted = np.array([one.acted for one in found])
    residual = np.array([one.residual_px for one in found])
    person = np.array([one.person for one in found])
    offsets = np.zeros((landmarks.num_landmarks, 3, len(scale)))
    left = np.zeros_like(residual)
    for point in range(landmarks.num_landmarks):
        one, left[:, point] = regress(derivative[:, point], terms, residual[:, point], person)
        offsets[point] = (one * scale[:, None]).T
    before, after = np.abs(residual).mean(), np.abs(left).mean()
    print(f"{len(found)} pictures: {before:.2f} px off before, {after:.2f} px after, left out")
    shares = np.einsum("fab,flb->fla", np.array([one.to_shares for one in found]), left)
    parts = np.split(offsets, np.cumsum(list(counts.values()))[:-1], axis=2)
    arrays = dict(zip(counts, parts))
    for name in ("rest", "jaw_open"):
        arrays[name] = arrays[name][..., 0]
    own_share = OWN_SHARE * np.sqrt(1 + (marks.spread_m / UNSURE_M) ** 2)
    arrays |= {"noise_modes": noise_modes(shares[acted]), "noise_own_share": own_share}
    return {name: values.astype(np.float16) for name, values in told_by_irises(arrays).items()}


def told_by_irises(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The asset in which irises err by themselves.

    The skin around eyes seems to follow them (corners by a fifth), which stays in the response:
    even where irises are known glances are found at .85 of their size without it, at .92 with it.
    """
    irises = np.arange(len(arrays["gaze"])) >= IRIS_CENTERS[0]
    arrays = {name: values.copy() for name, values in arrays.items()}
    arrays["noise_modes"][irises] = 0
    arrays["noise_own_share"][irises] = IRIS_OWN_SHARE
    return arrays


def main() -> None:
    """Write the asset."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=300)
    arrays = build(parser.parse_args().people)
    with atomic_write(RESPONSE_FILE) as partial:
        np.savez_compressed(partial, **arrays)  # pyright: ignore[reportArgumentType]
    print(f"{RESPONSE_FILE.name}: {RESPONSE_FILE.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
