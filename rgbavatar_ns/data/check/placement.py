"""Whether the head is drawn where the images show it, and if not, the likely cause.

Each known mistake is undone by way of trial: the one after which mesh and matte agree is named.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, Shaped

from rgbavatar_ns.data.check.problems import Problem, Severity
from rgbavatar_ns.data.check.sample import (
    Sample,
    inside_share,
    overlaps,
    projected,
    silhouettes,
)

HOPELESS_INSIDE, HOPELESS_IOU, HOPELESS_COVERED = 0.5, 0.25, 0.55
"""Below these no avatar can be trained. Good data has 1, .6 to .9 (hair), and .97 and more."""
_GOOD_COVERED = 0.9
_ZOOMS = (
    *(0.25, 0.35, 0.5, 0.6, 0.67, 0.72, 0.77, 0.83, 0.9),
    *(1.1, 1.2, 1.3, 1.4, 1.5, 1.7, 2.0, 2.8, 4.0, 6.0, 10.0),
)
_TOO_SHORT, _TOO_LONG = 1.35, 0.87
"""Zooms that hair, which no mesh has, cannot explain: it makes heads larger, never smaller."""
_MAYBE_SHORT, _GAIN_MAYBE = 1.15, 0.15
"""From here on hair or the focal length: asked about, not refused. Good data gains .08 at most."""
_GAIN_SHORT, _GAIN_LONG, _GAIN_SHIFT, _GAIN_AXES = 0.2, 0.08, 0.2, 0.3
_SHIFT_SHARE = 0.08
_EQUAL_AXES = 0.1
_UPRIGHT, _FACING = -0.5, -0.5
_LEAST_MOTION_PX, _MIRRORED = 0.5, -0.6
_LOOK = "Look at the contact sheet of `rgbavatar check DATA`: the mesh should lie on the face."


@dataclass(frozen=True)
class Fit:
    """How well head and mattes agree in a sample; means over its frames."""

    inside: float
    iou: float
    covered: float
    up: float
    """Cosine of the head's up and the image's up."""
    facing: float
    """Cosine of where the head looks and where the camera is."""
    mattes: bool

    @property
    def score(self) -> float:
        """Larger is better; its top is at the right zoom, with and without hair."""
        return self.iou + self.covered if self.mattes else 2 * self.inside

    @property
    def hopeless(self) -> bool:
        """Whether no avatar can be trained from this."""
        if self.inside < HOPELESS_INSIDE:
            return True
        return self.mattes and (self.iou < HOPELESS_IOU or self.covered < HOPELESS_COVERED)

    @property
    def oriented(self) -> bool:
        """Whether the head stands upright and is not seen from behind, as in any footage."""
        return self.up > _UPRIGHT and self.facing > _FACING


@dataclass(frozen=True)
class _Trial:
    """A mistake, and the sample with the mistake undone."""

    kind: str
    cause: str
    remedy: str
    undone: Sample
    least_gain: float = 0.0
    """In score, for it to be believed of data that is not hopeless."""


def measure_fit(sample: Sample) -> Fit:
    """Compare all frames of a sample."""
    projection = projected(sample)
    found = overlaps(sample, projection)
    iou = float(np.mean([one.iou for one in found])) if found else 0.0
    covered = float(np.mean([one.covered for one in found])) if found else 0.0
    inside = float(inside_share(sample, projection).mean())
    return Fit(inside, iou, covered, *_orientation(sample), sample.has_mattes)


def _orientation(sample: Sample) -> tuple[float, float]:
    """Medians over frames of the cosines in `Fit`."""
    rest = sample.rest - sample.rest.mean(0)
    middle = sample.vertices.mean(1)
    # The rotation that brings the head at rest nearest to where it is (Kabsch).
    left, _, right = np.linalg.svd((sample.vertices - middle[:, None]).transpose(0, 2, 1) @ rest)
    sign = np.sign(np.linalg.det(left @ right))
    left = left * np.stack([np.ones_like(sign), np.ones_like(sign), sign], -1)[:, None]
    turned = sample.world_to_camera[:, :3, :3] @ (left @ right)
    in_camera = np.einsum("fij,fj->fi", sample.world_to_camera[:, :3, :3], middle)
    in_camera += sample.world_to_camera[:, :3, 3]
    to_camera = -in_camera / np.linalg.norm(in_camera, axis=1, keepdims=True).clip(1e-9)
    up, forward = -turned[:, 1, 1], turned[:, :, 2]
    return float(np.median(up)), float(np.median((forward * to_camera).sum(1)))


def placement_problem(sample: Sample, only_hopeless: bool = False) -> Problem | None:
    """The likely cause of a head that is not where the images show it; None where it fits.

    With `only_hopeless` only of what cannot be trained.
    """
    fit = measure_fit(sample)
    if fit.hopeless:
        trials = [*_axes_trials(sample), *_zoom_trials(sample), *_shift_trials(sample)]
        if not fit.mattes:
            # Any size that lies inside would look well: only axes can be told.
            trials = [trial for trial in trials if trial.kind == "axes"]
        return _likeliest(_tried(trials)) or _misfit(fit, "error")
    if not fit.oriented:
        return _likeliest(_tried(_axes_trials(sample))) or _unoriented(fit)
    if only_hopeless or not fit.mattes:
        return None
    # Zooms so far off that hair could not explain them.
    zooms = [
        trial
        for zoom, trial in zip(_ZOOMS, _zoom_trials(sample))
        if zoom <= _TOO_LONG or zoom >= _TOO_SHORT
    ]
    tried = _tried([*zooms, *_shift_trials(sample)])
    found = _likeliest([one for one in tried if one[1].score >= fit.score + one[0].least_gain])
    if found is None and fit.covered < _GOOD_COVERED:
        tried = _tried(_axes_trials(sample))
        found = _likeliest([one for one in tried if one[1].score > fit.score + _GAIN_AXES])
        found = found or _misfit(fit, "warning")
    return found or _perhaps_too_small(sample, fit)


def _tried(trials: Iterable[_Trial]) -> list[tuple[_Trial, Fit]]:
    return [(trial, measure_fit(trial.undone)) for trial in trials]


def _likeliest(tried: list[tuple[_Trial, Fit]]) -> Problem | None:
    """The mistake whose undoing makes the best of the good fits, if there are any."""
    best: tuple[_Trial, Fit] | None = None
    for trial, fit in tried:
        # Of axes that fit about equally the first: the simpler mistakes come first.
        both_axes = best is not None and trial.kind == best[0].kind == "axes"
        margin = _EQUAL_AXES if both_axes else 0
        good = not fit.hopeless and fit.oriented
        if good and (best is None or fit.score > best[1].score + margin):
            best = trial, fit
    return None if best is None else Problem(best[0].kind, "error", best[0].cause, best[0].remedy)


def _misfit(fit: Fit, severity: Severity) -> Problem:
    if fit.inside < HOPELESS_INSIDE:
        return Problem(
            "outside",
            "error",
            f"Only {fit.inside:.0%} of the projected head lie inside the images.",
            f"Check the cameras' axes, units and focal length. {_LOOK}",
        )
    return Problem(
        "misfit",
        severity,
        f"The projected head does not fit the mattes: {fit.covered:.0%} of it lie on them, and "
        f"their overlap (IoU) is {fit.iou:.2f}.",
        f"Check head model, cameras and the pairing of images and parameters. {_LOOK}",
    )


def _unoriented(fit: Fit) -> Problem:
    how = "upside down" if fit.up <= _UPRIGHT else "from behind"
    return Problem(
        "axes",
        "error",
        f"The cameras see the head {how}: an axis is flipped.",
        f"Give cameras in OpenCV axes (x right, y down, z forward). {_LOOK}",
    )


def _axes_trials(sample: Sample) -> Iterator[_Trial]:
    """Cameras in other axes, or from camera to world."""
    given = sample.world_to_camera
    inverse = np.linalg.inv(given)
    flips = {
        "y and z flipped, as in OpenGL": np.diag([1.0, -1, -1, 1]),
        "x and y flipped, as in PyTorch3D": np.diag([-1.0, -1, 1, 1]),
        "x and z flipped": np.diag([-1.0, 1, -1, 1]),
    }
    causes: dict[str, np.ndarray] = {f"have {name}": flip @ given for name, flip in flips.items()}
    causes |= {f"belong to a world with {name}": given @ flip for name, flip in flips.items()}
    back = "go from camera to world"
    causes |= {back: inverse}
    causes |= {f"{back} and have {name}": flip @ inverse for name, flip in flips.items()}
    # Where a reader has taken such a matrix for one from camera to world.
    opengl = flips["y and z flipped, as in OpenGL"]
    causes["go from world to camera where camera to world is meant"] = opengl @ inverse @ opengl
    for cause, matrices in causes.items():
        yield _Trial(
            "axes",
            f"The cameras' axes are wrong: the matrices seem to {cause}.",
            "Datasets of the project's own have world-to-camera matrices in OpenCV axes (x right, "
            "y down, z forward) of a world with x to the subject's left, y up, z forward; another "
            "system's data needs that system's own axes (docs/dataset_format.md): mend what wrote "
            "the matrices.",
            replace(sample, world_to_camera=matrices),
        )


def _zoom_trials(sample: Sample) -> Iterator[_Trial]:
    """Other focal lengths."""
    for zoom in _ZOOMS:
        focal = float(np.median(sample.focal_px)) / sample.scale
        size = f"{1 / zoom:.1f} times too large" if zoom < 1 else f"{zoom:.1f} times too small"
        yield _Trial(
            "focal length",
            f"The head is drawn about {size}: the focal length of {focal:.0f} pixels looks wrong, "
            f"about {zoom * focal:.0f} fits.",
            "Check the focal length and the image size that it is given for; if they are right, "
            "check the unit of translations (metres) and the scale of the head.",
            replace(sample, focal_px=sample.focal_px * zoom),
            _GAIN_LONG if zoom < 1 else _GAIN_SHORT,
        )


def _perhaps_too_small(sample: Sample, fit: Fit) -> Problem | None:
    """A mesh so much smaller than the person that only an eye can tell whether it is hair."""
    scores = {
        zoom: measure_fit(replace(sample, focal_px=sample.focal_px * zoom)).score
        for zoom in _ZOOMS
        if _MAYBE_SHORT <= zoom < _TOO_SHORT
    }
    best = max(scores, key=lambda zoom: scores[zoom])
    if scores[best] < fit.score + _GAIN_MAYBE:
        return None
    focal = float(np.median(sample.focal_px)) / sample.scale
    return Problem(
        "focal length",
        "warning",
        f"The person's outline is about {best:.1f} times as large as the head mesh's: either there "
        f"is much hair, or the focal length of {focal:.0f} pixels is too short (about "
        f"{best * focal:.0f} would fit).",
        "Look at the contact sheet of `rgbavatar check DATA`: where the mesh's eyes and mouth lie "
        "on the person's, it is the hair, and all is well.",
    )


def _shift_trials(sample: Sample) -> Iterator[_Trial]:
    """The one shift, the same in all frames, that brings most of the mesh onto the mattes."""
    if not sample.has_mattes:
        return
    height, width = sample.alpha.shape[1:]
    border = ((0, 0), (height, height), (width, width))
    wide = replace(
        sample,
        alpha=np.pad(sample.alpha, border),
        gray=np.pad(sample.gray, border),
        filmed=np.pad(sample.filmed, border, constant_values=True),
    )
    middle = np.array([width, height])
    # Drawn on a larger canvas, a head beside the image can be shifted back into it.
    drawn = silhouettes(
        wide, projected(replace(wide, principal_point_px=wide.principal_point_px + middle))
    )
    spectrum = np.fft.rfft2(wide.alpha > 0.5) * np.fft.rfft2(drawn).conj()
    common = np.fft.irfft2(spectrum.sum(0), wide.alpha.shape[1:])
    either = (wide.alpha > 0.5).sum() + drawn.sum() - common
    fit = common / max(drawn.sum(), 1) + common / either.clip(1)
    rows, columns = fit.shape
    row, column = np.unravel_index(int(fit.argmax()), fit.shape)
    shift = np.array([(column + width) % columns - width, (row + height) % rows - height])
    if np.linalg.norm(shift) < _SHIFT_SHARE * max(width, height):
        return
    x, y = np.round(shift / sample.scale).astype(int)
    yield _Trial(
        "principal point",
        f"The head is drawn beside the person: it fits {abs(x)} pixels further "
        f"{'right' if x > 0 else 'left'} and {abs(y)} further {'down' if y > 0 else 'up'}.",
        "Check the principal point, and whether images were cropped or scaled after tracking.",
        replace(sample, principal_point_px=sample.principal_point_px + shift),
        _GAIN_SHIFT,
    )


def mirrored_problem(sample: Sample) -> Problem | None:
    """Whether the head moves to one side while the person, in motion, moves to the other."""
    if not sample.has_mattes or len(sample) < 4:
        return None
    drawn = (silhouettes(sample, projected(sample)) > 0.5) & sample.filmed
    mattes = sample.alpha > 0.5
    height, width = sample.alpha.shape[1:]
    for axis, places, name in ((2, np.arange(width), "x"), (1, np.arange(height), "y")):
        other = 3 - axis
        mesh = _centers(drawn.sum(other), places)
        matte = _centers(mattes.sum(other), places)
        if min(mesh.std(), matte.std()) < _LEAST_MOTION_PX:
            continue
        if np.corrcoef(mesh, matte)[0, 1] < _MIRRORED:
            sides = "sideways" if name == "x" else "up and down"
            return Problem(
                "mirrored",
                "error",
                f"The head moves {sides} against the person in the images: they are mirrored, or "
                f"the {name} axis of the parameters or the cameras is flipped.",
                f"Mirror the images, or flip the axis. {_LOOK}",
            )
    return None


def _centers(
    counts: Shaped[np.ndarray, "F n"], places: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "F"]:
    return (counts * places).sum(1) / counts.sum(1).clip(1)
