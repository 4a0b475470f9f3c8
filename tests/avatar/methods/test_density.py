import copy
import dataclasses
import math

import numpy as np
import pytest
import torch

from rgbavatar_ns.avatar.methods.density import (
    DensityChanges,
    DensityControl,
    control,
    prune_and_refill,
    sampled_positions,
)
from rgbavatar_ns.avatar.training.losses import random_backgrounds
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.kernels import available_backends, rasterize
from rgbavatar_ns.kernels.reference import rotation_matrices
from tests.kernels.scenes import random_cameras, to

from .splats import PARAMETERS, Splats, adam, all_equal, everything, learn, moments

EVERY = DensityControl(
    from_step=0, every=1, reset_every=0, largest_scale=0.0, min_opacity=0.005, extent_m=1.0
)
"""After every step, nothing but densifying and pruning by opacity; 1 cm divides small and large."""
FAINT = math.log(0.001 / 0.999)


def ready(count: int = 12, **arguments) -> tuple[Splats, torch.optim.Adam]:
    """Gaussians that have learnt, none of which is to change."""
    splats = Splats(count, **arguments)
    optimizer = adam(splats)
    learn(splats, optimizer, 2)
    return splats, optimizer


def want(splats: Splats, *rows: int) -> None:
    """Let the mean gradient of these be twice the threshold."""
    splats.statistics.times_seen += 5
    for row in rows:
        splats.statistics.gradient_sum[row] = 5 * 4e-4


def run(splats, optimizer, options=EVERY, *, step=0, seed=0, controlled=None):
    given = controlled or splats.controlled()
    return control(given, options, [optimizer], step=step, seed=seed)


def test_changes_come_when_3dgs_makes_them():
    options = DensityControl(from_step=500, until_step=900, every=100, reset_every=300)
    assert [s + 1 for s in range(2000) if options.due(s)] == [600, 700, 800]
    assert [s + 1 for s in range(2000) if options.resets(s)] == [300, 600]
    assert [options.watches(s) for s in (0, 898, 899)] == [True, True, False]
    splats, optimizer = ready()
    want(splats, 0)
    before = everything(splats, optimizer)
    assert run(splats, optimizer, options, step=600) is None
    assert all_equal(before, everything(splats, optimizer))


def test_where_nothing_is_to_change_nothing_does():
    splats, optimizer = ready()
    splats.position.grad = torch.ones_like(splats.position)
    before = everything(splats, optimizer)
    assert run(splats, optimizer) == DensityChanges(count=12)
    assert all_equal(before, everything(splats, optimizer))
    assert splats.position.grad is not None


def test_clones_splits_and_prunes_as_worked_by_hand():
    splats, optimizer = ready(5)
    with torch.no_grad():
        splats.log_scale[2, 1] = math.log(0.02)
        splats.opacity_logit[3:] = FAINT
    want(splats, 1, 2, 4)
    rows = {name: splats.rows[name].detach().clone() for name in PARAMETERS}
    remembered = {n: [m.clone() for m in moments(optimizer, splats.rows[n])] for n in PARAMETERS}

    changes = run(splats, optimizer)

    # 0 stays, 1 is cloned, 2 split, 3 pruned, 4 cloned and then pruned with its clone.
    assert changes == DensityChanges(cloned=2, split=1, pruned=3, count=5)
    origin = [0, 1, 1, 2, 2]
    assert splats.triangle_of.tolist() == [n % 4 for n in origin]
    for name, value in rows.items():
        changed = 3 if name in ("position", "log_scale") else 5
        assert torch.equal(splats.rows[name][:changed], value[origin[:changed]]), name
        assert len(splats.rows[name]) == 5
    torch.testing.assert_close(
        splats.log_scale.exp()[3:], rows["log_scale"][[2, 2]].exp() / 1.6, rtol=1e-6, atol=0
    )
    assert len({*map(tuple, splats.position[[2, 3, 4]].tolist())}) == 3
    for name, values in remembered.items():
        for value, now in zip(values, moments(optimizer, splats.rows[name])):
            assert torch.equal(now[:2], value[:2])
            assert not now[2:].any()
    assert not splats.statistics.gradient_sum.any()
    assert not splats.statistics.times_seen.any()
    assert splats.statistics.gradient_sum.shape == (5,)
    learn(splats, optimizer, 1)


@pytest.mark.parametrize("backend", available_backends())
def test_pruning_what_is_never_drawn_leaves_the_picture(backend):
    splats, optimizer = ready(60)
    with torch.no_grad():
        splats.log_scale += 2
        splats.opacity_logit[::3] = math.log(0.99 / 255 / (1 - 0.99 / 255))
        splats.opacity_logit[1] = math.log(1.01 / 255 / (1 - 1.01 / 255))
    camera = to(random_cameras(torch.Generator().manual_seed(0), 1, 48, 40), torch.float32)

    def picture() -> torch.Tensor:
        with torch.no_grad():
            return rasterize(splats.gaussian_set(), camera, backend=backend).image

    before = picture()
    assert (before.amax(-1) > 0.01).float().mean() > 0.1
    changes = run(splats, optimizer, dataclasses.replace(EVERY, min_opacity=1 / 255))
    assert changes.pruned == 20
    assert changes.count == 40
    # One rounding: sums over what is left are taken in other groups.
    torch.testing.assert_close(picture(), before, rtol=0, atol=1e-7)
    run(splats, optimizer, dataclasses.replace(EVERY, min_opacity=0.5))
    assert (picture() - before).abs().max() > 1e-3


def test_children_are_samples_of_their_parent():
    parents = 20_000
    splats, optimizer = ready(2)
    with torch.no_grad():
        splats.log_scale[1] = torch.tensor([0.3, 0.05, 0.01]).log()
        splats.opacity_logit[:] = 1
    splats.rows.take(torch.ones(parents, dtype=torch.int64), [optimizer])
    place, turn = splats.position[0].detach(), rotation_matrices(splats.rotation_wxyz[0].double())
    scale = splats.log_scale[0].exp().double()
    want(splats, *[slice(None)])
    changes = run(splats, optimizer, seed=3, step=7)
    assert changes == DensityChanges(split=parents, count=2 * parents)
    white = ((splats.position - place).double() @ turn / scale).detach()
    # Standard normal: the mean of n has the deviation n^-1/2, products of two coordinates the
    # same, the variance (2 / n)^1/2. Five deviations of nine numbers: one in 200,000.
    count = len(white)
    assert white.mean(0).abs().max() < 5 * count**-0.5
    departure = white.T @ white / count - torch.eye(3)
    assert departure.diagonal().abs().max() < 5 * (2 / count) ** 0.5
    assert (departure - departure.diagonal().diag()).abs().max() < 5 * count**-0.5
    pairs = white.reshape(parents, 2, 3)
    assert (pairs[:, 0] * pairs[:, 1]).mean(0).abs().max() < 5 * parents**-0.5


def test_samples_are_turned_and_scaled_as_worked_by_hand():
    half = math.sqrt(0.5)
    place = sampled_positions(
        torch.tensor([[10.0, 20.0, 30.0]]),
        torch.tensor([[2 * half, 0.0, 0.0, 2 * half]]),  # a quarter about z, not normalised
        torch.tensor([[1.0, 2.0, 3.0]]),
        torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]]),
    )
    expected = torch.tensor([[[10.0, 21.0, 30.0], [8.0, 20.0, 33.0]]])
    torch.testing.assert_close(place, expected)


def test_step_and_seed_alone_decide():
    def positions(seed: int, step: int) -> torch.Tensor:
        splats, optimizer = ready()
        with torch.no_grad():
            splats.log_scale[:4] = -2
        want(splats, 0, 1, 2, 3)
        run(splats, optimizer, seed=seed, step=step)
        return splats.position.detach()

    first = positions(1, 4)
    torch.rand(3)
    assert torch.equal(positions(1, 4), first)
    assert not torch.equal(positions(2, 4), first)
    assert not torch.equal(positions(1, 5), first)
    splats, optimizer = ready()
    splats.log_scale.data[:] = -2
    want(splats, 0)
    state = torch.random.get_rng_state()
    assert run(splats, optimizer).split == 1
    assert torch.equal(torch.random.get_rng_state(), state)


def test_each_parents_children_lie_around_it():
    splats, optimizer = ready()
    parents = [2, 5, 7]
    with torch.no_grad():
        splats.position[:, 0] = torch.arange(12.0)
        splats.log_scale[parents] = -4
    want(splats, *parents)
    assert run(splats, optimizer).split == 3
    assert splats.position[-6:, 0].round().tolist() == [2, 2, 5, 5, 7, 7]
    assert splats.triangle_of[-6:].tolist() == [2, 2, 1, 1, 3, 3]


def test_samples_are_not_of_the_stream_that_backgrounds_are_of():
    splats, optimizer = ready(3)
    keep = torch.tensor([True, False, False])
    prune_and_refill(splats.rows, keep, 3, [optimizer], jitter_m=1.0, step=5, seed=2, remedy="")
    moved = (splats.position[1:] - splats.position[0] + 0.5).detach()

    stream = np.random.Generator(np.random.Philox(key=np.array([2, 5], dtype=np.uint64)))
    background = random_backgrounds(5, 2, seed=2)
    again = torch.from_numpy(stream.random((2, 3), dtype=np.float32))
    assert torch.equal(background, again)
    stream = np.random.Generator(np.random.Philox(key=np.array([2, 5], dtype=np.uint64)))
    stream.integers(1, size=2)
    assert (moved - torch.from_numpy(stream.random((2, 3)))).abs().max() > 1e-3


def test_size_is_that_in_the_world():
    splats, optimizer = ready(4)
    want(splats, 0, 1)
    with torch.no_grad():
        splats.log_scale[:] = math.log(0.5)
    sizes_m = torch.tensor([0.019, 0.021, 1.0, 1.0])  # times .5: on either side of a centimetre
    changes = run(splats, optimizer, controlled=splats.controlled(sizes_m))
    assert changes == DensityChanges(cloned=1, split=1, count=6)
    assert splats.triangle_of.tolist() == [0, 2, 3, 0, 1, 1]


@pytest.mark.parametrize(("extent_m", "split"), [(0.5, 2), (1.0, 1), (2.0, 0)])
def test_small_is_a_share_of_the_extent(extent_m, split):
    splats, optimizer = ready()
    want(splats, 0, 1)
    with torch.no_grad():
        splats.log_scale[:2] = torch.tensor([0.007, 0.015]).log()[:, None]
    changes = run(splats, optimizer, dataclasses.replace(EVERY, extent_m=extent_m))
    assert (changes.split, changes.cloned) == (split, 2 - split)
    assert changes.count == 14


def test_the_large_are_pruned_once_their_time_has_come():
    splats, optimizer = ready()
    options = dataclasses.replace(EVERY, largest_scale=0.1, largest_scale_from_step=10)
    with torch.no_grad():
        splats.log_scale[3, 2] = math.log(0.11)
        splats.log_scale[4, 0] = math.log(0.09)
    assert run(splats, optimizer, options, step=9) == DensityChanges(count=12)
    kept = splats.position[[0, 1, 2, *range(4, 12)]].detach().clone()
    assert run(splats, optimizer, options, step=10) == DensityChanges(pruned=1, count=11)
    assert torch.equal(splats.position, kept)


def test_a_reset_bounds_opacities_and_raises_none():
    splats, optimizer = ready()
    options = dataclasses.replace(EVERY, reset_every=4, from_step=1000)
    with torch.no_grad():
        splats.opacity_logit[:4] = FAINT
    before = splats.opacity_logit.detach().clone()
    others = [
        [m.clone() for m in moments(optimizer, splats.rows[n])]
        for n in PARAMETERS
        if n != "opacity_logit"
    ]
    splats.statistics.times_seen += 1
    assert run(splats, optimizer, options, step=2) is None
    assert run(splats, optimizer, options, step=3) == DensityChanges(opacity_reset=True, count=12)
    opacity = splats.opacity_logit.sigmoid()
    assert (splats.opacity_logit <= before).all()
    assert torch.equal(splats.opacity_logit[:4], before[:4])
    torch.testing.assert_close(opacity[4:], torch.full((8,), 0.01))
    assert not any(m.any() for m in moments(optimizer, splats.opacity_logit))
    now = [moments(optimizer, splats.rows[n]) for n in PARAMETERS if n != "opacity_logit"]
    assert all(all_equal(a, b) for a, b in zip(others, now))
    assert (splats.statistics.times_seen == 1).all()
    # What a reset leaves is not pruned by the next change.
    pruning = dataclasses.replace(options, from_step=0)
    assert run(splats, optimizer, pruning, step=4).count == 8


@pytest.mark.parametrize("seed", range(5))
def test_every_triangle_keeps_a_gaussian_by_the_rule(seed):
    splats, optimizer = ready(40, seed=seed, triangles=13)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        faint = torch.rand(40, generator=generator) < 0.7
        splats.opacity_logit[faint] = FAINT
    faces = set(splats.triangle_of.tolist())
    bright = set(splats.triangle_of[~faint].tolist())
    lone = int(sum(int(face) not in bright for face in splats.triangle_of))
    assert bright < faces
    options = dataclasses.replace(EVERY, keep_one_per_face=True)
    controlled = splats.controlled(face_of="triangle_of")
    changes = run(splats, optimizer, options, controlled=controlled)
    assert set(splats.triangle_of.tolist()) == faces
    assert changes.kept_for_faces == lone
    assert changes.pruned == int(faint.sum()) - lone
    assert changes.count == 40 - changes.pruned
    assert run(splats, optimizer, EVERY).pruned == lone
    assert set(splats.triangle_of.tolist()) == bright
    with pytest.raises(ValueError, match="face_of"):
        run(splats, optimizer, options)


def test_there_are_never_more_than_allowed_and_the_largest_gradients_come_first():
    splats, optimizer = ready()
    splats.statistics.times_seen += 1
    splats.statistics.gradient_sum += 1e-3 * torch.tensor([5, 1, 9, 0, 9, 3, 2, 8, 4, 6, 7, 1.0])
    with torch.no_grad():
        splats.log_scale[2] = -3
    options = dataclasses.replace(EVERY, max_count=15)
    origin = splats.color[:, 0, 0].detach().clone()
    assert run(splats, optimizer, options) == DensityChanges(cloned=2, split=1, count=15)
    expected = torch.tensor([0, 1, *range(3, 12), 4, 7, 2, 2])
    assert torch.equal(splats.color[:, 0, 0], origin[expected])
    want(splats, 0, 1)
    assert run(splats, optimizer, options) == DensityChanges(count=15)


def test_what_would_remove_everything_is_told():
    splats, optimizer = ready()
    with torch.no_grad():
        splats.opacity_logit[:] = FAINT
    before = everything(splats, optimizer)
    with pytest.raises(UserError, match=r"each of 12 .* opaque than 0\.005"):
        run(splats, optimizer)
    assert all_equal(before, everything(splats, optimizer))
    with pytest.raises(UserError, match=r"as faint as 0\.01 would all be removed"):
        DensityControl(min_opacity=0.01)
    assert DensityControl(min_opacity=0.01, reset_every=0).min_opacity == 0.01


def test_an_extent_of_nothing_is_told():
    with pytest.raises(UserError, match=r"one still camera.* Give extent_m"):
        DensityControl(extent_m=0.0)
    for value in (-1.0, math.nan, math.inf):
        with pytest.raises(UserError, match="--extent-m"):
            DensityControl(extent_m=value)


def test_refilled_points_lie_around_what_remains():
    splats, optimizer = ready()
    keep = torch.arange(12) % 3 == 0
    rows = {name: splats.rows[name].detach().clone() for name in PARAMETERS}
    remembered = [m[keep].clone() for m in moments(optimizer, splats.position)]

    def refill(**changes):
        arguments = {"jitter_m": 0.02, "step": 3, "seed": 1, "remedy": "Keep more."} | changes
        return prune_and_refill(splats.rows, keep, 400, [optimizer], **arguments)

    assert refill() == DensityChanges(cloned=396, pruned=8, count=400)
    for name, value in rows.items():
        assert torch.equal(splats.rows[name][:4], value[keep]), name
    for value, now in zip(remembered, moments(optimizer, splats.position)):
        assert torch.equal(now[:4], value)
        assert not now[4:].any()
    away = splats.position[4:, None] - splats.position[:4]
    nearest, origin = away.abs().amax(-1).min(1)
    assert nearest.max() <= 0.01
    assert nearest.min() > 0
    assert nearest.max() > 0.009
    assert torch.bincount(origin, minlength=4).min() > 50
    assert torch.equal(splats.color[4:], splats.color[:4][origin])
    learn(splats, optimizer, 1)

    keep = torch.ones(400, dtype=torch.bool)
    before = everything(splats, optimizer)
    assert refill() == DensityChanges(count=400)
    assert all_equal(before, everything(splats, optimizer))
    keep = torch.zeros(400, dtype=torch.bool)
    with pytest.raises(UserError, match=r"leave nothing.* removed\. Keep more\."):
        refill()


def test_a_resumed_run_changes_as_the_uninterrupted_one():
    options = dataclasses.replace(EVERY, every=4, reset_every=7, gradient_threshold=1.0)

    def train(splats, optimizer, steps) -> None:
        for step in steps:
            learn(splats, optimizer, 1, seed=step)
            generator = torch.Generator().manual_seed(step)
            gradient = torch.randn(2, splats.rows.count, 2, generator=generator)
            splats.statistics.add(0.2 * gradient, 4, 4)
            control(splats.controlled(), options, [optimizer], step=step, seed=9)

    whole = Splats(triangles=3)
    with torch.no_grad():
        whole.log_scale[::2] = -3
    first = adam(whole)
    train(whole, first, range(10))
    stored = {name: value.clone() for name, value in whole.state_dict().items()}
    stored_optimizer = copy.deepcopy(first.state_dict())
    resumed = Splats(seed=4)
    second = adam(resumed)
    resumed.rows.fit_to(stored)
    resumed.load_state_dict(stored)
    second.load_state_dict(stored_optimizer)
    at_the_break = resumed.rows.count
    train(whole, first, range(10, 20))
    train(resumed, second, range(10, 20))
    assert 12 != at_the_break != resumed.rows.count
    assert all_equal(everything(whole, first), everything(resumed, second))
