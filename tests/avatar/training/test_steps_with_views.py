"""Steps in which a view that nobody filmed takes a frame's place: every way takes the same."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from rgbavatar_ns.avatar.prior import (
    NUM_VIEWS,
    SurfacePrior,
    VirtualViews,
    surface_prior,
    virtual_views,
)
from rgbavatar_ns.avatar.refinement import FrameRefinement, RefinementConfig
from rgbavatar_ns.avatar.training import (
    TrainingBatch,
    TrainingOptions,
    TrainingStep,
    make_optimizer,
)
from rgbavatar_ns.avatar.training.batches import ChosenFrames, DeviceFrames
from tests.avatar.fused_scene import far_batch, parting, stir

SIZE, EVERY = 24, 2


@pytest.fixture(autouse=True)
def _the_prior_is_busy(monkeypatch):
    """A view every other step; looks before steps 0, 1, 2 and 5, and a pull after the last."""
    monkeypatch.setattr(virtual_views, "_FRAMES_A_VIEW", 2 * EVERY)
    for name, value in (("EVERY", 3), ("_FIRST_STEP", 0), ("_FIRST_PULL", 3)):
        monkeypatch.setattr(surface_prior, name, value)


def trained(make_avatar, kind: str, steps: int = 7, room: int = 0):
    """An avatar after steps on two of four frames each, with a camera of their own.

    Recorded steps put views into the room for so many images behind the frames, not elsewhere.
    """
    avatar = stir(make_avatar())
    batch, background = far_batch(avatar, 4, SIZE, SIZE, cameras=4)
    frames = DeviceFrames(batch.theta, batch.cameras, batch.images_rgba)
    if room:
        memory = torch.cat([batch.images_rgba, batch.images_rgba.new_zeros(room, SIZE, SIZE, 4)])
        frames = replace(frames, images_rgba=memory[:4], room=memory)
    optimizer = make_optimizer(avatar)
    for group in optimizer.param_groups:
        group["lr"] *= 0.1
    options = TrainingOptions(fast=kind != "eager")
    given = (lambda: frames) if kind == "recorded" else None
    take = TrainingStep(avatar, optimizer, options, frames=given, recorder=lambda work: work)
    assert take.kind == kind
    for step in range(steps):
        rows = [step % 4, (step + 2) % 4]
        colors = background[rows]
        chosen = frames.batch(rows)
        images = TrainingBatch(chosen.theta, chosen.cameras, chosen.images_rgba, colors)
        take(ChosenFrames(rows, colors) if kind == "recorded" else images, step)
    if room:
        assert take._shown is not None
        assert len(take._shown.images_rgba) == 4 + NUM_VIEWS
        assert take._shown.images_rgba.data_ptr() == frames.images_rgba.data_ptr()
        assert torch.equal(frames.images_rgba, batch.images_rgba)
    return avatar


def test_recorded_fused_and_eager_steps_show_the_same_views(emulated, make_avatar, monkeypatch):
    recorded, fused, eager = (trained(make_avatar, kind) for kind in ("recorded", "fused", "eager"))
    assert parting(recorded, fused) < 1e-4
    assert parting(eager, fused) < 1e-4
    with monkeypatch.context() as patch:
        patch.setattr(VirtualViews, "due", lambda self, step, size: None)
        assert parting(trained(make_avatar, "fused"), fused) > 1e-2
    monkeypatch.setattr(SurfacePrior, "pull", lambda self, avatar, step: None)
    assert parting(trained(make_avatar, "fused"), fused) > 1e-3


def test_views_lie_behind_the_films_images_without_a_copy_of_these(emulated, make_avatar):
    behind, apart = (trained(make_avatar, "recorded", room=n) for n in (NUM_VIEWS, 0))
    assert parting(behind, apart) == 0


@pytest.mark.parametrize("kind", ["recorded", "fused", "eager"])
def test_views_of_another_size_than_the_films_are_left_out(emulated, make_avatar, kind):
    avatar, colors = stir(make_avatar()), torch.rand(2, 3)
    prior, optimizer = SurfacePrior(avatar), make_optimizer(avatar)
    options = TrainingOptions(fast=kind != "eager")
    for size, first in ((SIZE, 0), (SIZE + 8, 4)):
        batch, _ = far_batch(avatar, 4, size, size, cameras=4)
        frames = DeviceFrames(batch.theta, batch.cameras, batch.images_rgba)
        given = None if kind != "recorded" else partial(lambda them: them, frames)
        take = TrainingStep(
            avatar, optimizer, options, frames=given, recorder=lambda work: work, prior=prior
        )
        for step in range(first, first + 4):
            images = replace(frames.batch([0, 2]), background=colors)
            losses = take(ChosenFrames([0, 2], colors) if kind == "recorded" else images, step)
            assert losses["l1"].isfinite()


@pytest.mark.parametrize("fast", [True, False])
def test_a_view_may_take_the_place_of_a_batchs_only_frame(make_avatar, fast):
    """It gives no first colours: nobody filmed it."""
    avatar, view_step = stir(make_avatar()), 2 * EVERY
    batch, background = far_batch(avatar, 1, SIZE, SIZE)
    prior = SurfacePrior(avatar)
    take = TrainingStep(avatar, options=TrainingOptions(fast=fast), prior=prior)
    for step in range(view_step):
        take(replace(batch, background=background), step)
    assert prior.views.due(view_step, 1) is not None
    avatar.color_initialized.zero_()
    losses = take(replace(batch, background=background), view_step)
    assert losses["l1"].isfinite()
    assert not avatar.color_initialized.any()


def test_a_frame_that_a_view_displaced_is_not_refined_by_it(make_avatar):
    avatar = stir(make_avatar())
    batch, background = far_batch(avatar, 4, SIZE, SIZE)
    config = RefinementConfig(start_step=0)
    refinement = FrameRefinement(batch.theta, list(range(4)), avatar.layout, config)
    take = TrainingStep(avatar, refinement=refinement)
    visits = []
    for step in range(2):
        position = torch.tensor([3, 1])
        images = batch.images_rgba[position]
        take(
            TrainingBatch(batch.theta[position], batch.cameras, images, background[:2], position),
            step,
        )
        visits.append(refinement.frames.visits.tolist())
    assert visits == [[0, 0, 0, 1], [0, 1, 0, 2]]


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
def test_one_set_of_a_batch_is_drawn_by_itself(make_avatar, backend, request):
    if backend == "cuda":
        request.getfixturevalue("emulated")
    avatar = stir(make_avatar())
    batch, _ = far_batch(avatar, 3, 40, 31)
    renderer = avatar.renderer(batch.theta, batch.cameras, backend=backend)
    together = renderer.draw()
    for place in (2, 0, 1):
        alone = renderer.draw_one(place)
        assert torch.equal(alone.image, together.image[[place]])
        assert torch.equal(alone.alpha, together.alpha[[place]])
    assert not torch.equal(together.image[0], together.image[2])
    for place in (-1, 3):
        with pytest.raises(ValueError, match="no set"):
            renderer.draw_one(place)
