"""One made-up person drives another, whose true picture at that expression is ray-cast.

Each subject's tracker is biased in its own way, as trackers are by another person's rest: what it
calls theta is the truth plus a constant. The avatar is made from the target's own tracked frame.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar import Avatar, AvatarConfig
from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics, expressive_numbers
from rgbavatar_ns.avatar.training.color_init import FirstColors
from rgbavatar_ns.driving import DrivingOptions, NamedMap, ThetaNames, drive
from rgbavatar_ns.export import draw
from rgbavatar_ns.synthetic.config import DemoConfig
from rgbavatar_ns.synthetic.make import DemoPerson, as_pinhole
from rgbavatar_ns.synthetic.performer.performance import perform

from .subject import psnr

_SIZE, _FRAMES = 64, 24
_SHOWN = [6, 12, 18]


def _performance(person: DemoPerson, seed: int) -> torch.Tensor:
    """A performance that begins with the head at rest."""
    names = person.head.arrays.expression_names
    played = perform(person.head.layout, names, _FRAMES, 6, 8.0, seed)
    theta = torch.from_numpy(played).float()
    theta[0] = 0
    return theta


def _bias(person: DemoPerson, **amounts: float) -> torch.Tensor:
    """What a tracker adds to every frame."""
    layout, names = person.head.layout, person.head.arrays.expression_names
    bias = torch.zeros(layout.size)
    for name, amount in amounts.items():
        if name == "jaw":
            bias[layout.slice("jaw").start] = amount
        else:
            bias[layout.slice("expression").start + names.index(name)] = amount
    return bias


@dataclass
class _Pair:
    target: DemoPerson
    avatar: Avatar
    own: TrainingStatistics
    truth_of_driver: torch.Tensor
    tracked_of_driver: torch.Tensor
    bias_of_target: torch.Tensor


@pytest.fixture(scope="module")
def pair() -> _Pair:
    target = DemoPerson.of(
        DemoConfig(image_size=_SIZE, seed=0, glasses=False, supersampling=1, wrinkles=0.0)
    )
    bias_of_target = _bias(target, mouthFrownLeft=0.15, mouthFrownRight=0.15)
    theta = _performance(target, seed=0)
    avatar = Avatar(
        target.head,
        target.identity,
        AvatarConfig(num_bases=0, uv_resolution=96, scale_from_texel_spacing=True),
    )
    with torch.no_grad():
        avatar.blendshapes.opacity_logit.fill_(2.5)
    (image,) = target.draw(theta[:1])
    colors, rgba = FirstColors(avatar), torch.from_numpy(image)[None]
    black = torch.zeros(1, 3)
    colors.give(colors.seen_in(theta[:1], as_pinhole(target.camera), rgba, black))
    tracked = theta + bias_of_target
    own = TrainingStatistics.of(tracked, torch.zeros(_FRAMES, 1), target.head.layout)
    truth = _performance(target, seed=5)
    bias = _bias(target, mouthSmileLeft=0.35, mouthSmileRight=0.35, browInnerUp=0.4, jaw=0.08)
    return _Pair(target, avatar, own, truth, truth + bias, bias_of_target)


def _driven(pair: _Pair, options: DrivingOptions) -> torch.Tensor:
    """The avatar's theta, without what its own tracker adds: comparable with the truth."""
    names = ThetaNames.of(pair.target.head.layout, pair.target.head.arrays)
    mapped = NamedMap(names, names)(pair.tracked_of_driver)
    mapped = drive(mapped, names.layout, pair.own, 8.0, options)
    assert mapped.unmapped == mapped.missing == ()
    return mapped.theta - pair.bias_of_target


def _expression_error_mm(pair: _Pair, theta: torch.Tensor) -> float:
    """Mean distance of the target's vertices from where the driver's true expression puts them.

    The head's pose is left out: two performances need not have the same mean pose.
    """
    head, identity = pair.target.head, pair.target.identity
    moving = expressive_numbers(head.layout)
    there, truth = (head(several * moving, identity) for several in (theta, pair.truth_of_driver))
    distance = (there - truth).norm(dim=-1)
    return 1000 * distance.mean().item()


def _quality(pair: _Pair, theta: torch.Tensor) -> tuple[float, float]:
    """PSNR against the avatar at the true expression, and against the ray-cast person at it."""
    camera = as_pinhole(pair.target.camera)
    truth = pair.truth_of_driver[_SHOWN]
    drawn, best = (
        draw(pair.avatar, several, camera, (0.0, 0.0, 0.0)).image.numpy().clip(0, 1)
        for several in (theta[_SHOWN], truth)
    )
    rgba = np.stack(list(pair.target.draw(truth))) / 255
    return psnr(drawn, best), psnr(drawn, rgba[..., :3] * rgba[..., 3:])


@pytest.mark.slow
@torch.no_grad()
def test_relative_driving_is_nearer_to_the_target_at_the_drivers_expression(pair):
    results = {}
    for relative in ("neutral", "mean", "off"):
        theta = _driven(pair, DrivingOptions(relative, pose="absolute"))
        results[relative] = (_expression_error_mm(pair, theta), *_quality(pair, theta))
    neutral, absolute = results["neutral"], results["off"]
    assert neutral[0] < 0.01, "the neutrals are known, so nothing is left of the biases"
    assert absolute[0] > 0.3
    assert neutral[1] > 60
    assert absolute[1] < 40
    assert neutral[2] > absolute[2]
    assert results["mean"][0] < absolute[0]


@torch.no_grad()
def test_driving_keeps_the_targets_identity(pair):
    head, identity = pair.target.head, pair.target.identity
    drivers = torch.randn(head.num_identity, generator=torch.Generator().manual_seed(1))
    driven = _driven(pair, DrivingOptions(pose="absolute"))
    # At rest the avatar is the target; at any expression it is the target with it, not the driver.
    own = head(torch.zeros(1, head.layout.size), identity)
    assert (head(driven[:1], identity) - own).norm(dim=-1).max() < 1e-6
    moved = head(driven, identity)
    to_target = (moved - head(pair.truth_of_driver, identity)).norm(dim=-1).mean()
    to_driver = (moved - head(pair.truth_of_driver, drivers)).norm(dim=-1).mean()
    assert to_target < 0.01 * to_driver
