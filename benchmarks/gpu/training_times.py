"""Training as it is: with all that is due beside a step, with corrected tracking, from a stream."""

import importlib.util
import time

import torch

from benchmarks.gpu.rows import Figures, Rows, check
from benchmarks.gpu.targets import AVATAR_IMAGES, AVATAR_SECONDS, at_most
from benchmarks.gpu.workload import BARE, WARM_UP_STEPS, Step, Training, Workload
from rgbavatar_ns.avatar.refinement import FrameRefinement
from rgbavatar_ns.avatar.training import TrainingOptions, TrainingStep
from rgbavatar_ns.avatar.training.batches import ChosenFrames, TrainingBatch
from rgbavatar_ns.avatar.training.losses import random_backgrounds


def whole_run(rows: Rows) -> None:
    """An avatar of 50,000 images with the preset's options, or as many as there is time for."""
    work = Workload.here()
    training = Training(work)
    # It measures outlines by OpenCV, which a bare machine lacks.
    surface_prior = importlib.util.find_spec("cv2") is not None
    with rows.row("whole_run") as figures:
        start = time.perf_counter()
        options = TrainingOptions(surface_prior=surface_prior, backend="cuda")
        take = training.unrecorded(options)
        losses, number = [], 0

        def step() -> None:
            nonlocal number
            background = random_backgrounds(number, work.batch)
            losses.append(take(ChosenFrames(training.rows(), background), number)["l1"])
            number += 1

        for _ in range(WARM_UP_STEPS):
            step()
        work.wait()
        ready = time.perf_counter()
        while (
            number * work.batch < AVATAR_IMAGES and time.perf_counter() < ready + work.run_seconds
        ):
            step()
        work.wait()
        rate = (number - WARM_UP_STEPS) * work.batch / (time.perf_counter() - ready)
        whole_s = ready - start + AVATAR_IMAGES / rate
        figures |= {
            "step": f"{take.kind}: {take.reason}",
            "surface_prior": surface_prior,
            "images": number * work.batch,
            "ready_s": ready - start,
            "images_per_second": rate,
            "seconds_for_50000": whole_s,
            **at_most(whole_s, AVATAR_SECONDS),
        }
        found = torch.stack(losses).cpu()
        figures |= {"first_loss": float(found[0]), "last_loss": float(found[-1])}
        check(figures, bool(found.isfinite().all()), "a loss is not finite")
        check(figures, bool(found[-1] < found[0]), "nothing is learnt")


def refinement(rows: Rows) -> None:
    """A step that also corrects the frames' theta."""
    work = Workload.here()
    training = Training(work)
    with rows.row("refinement") as figures:
        theta = training.frames.theta
        corrections = FrameRefinement(theta.cpu(), range(work.frames), training.avatar.layout).to(
            work.device
        )
        take = TrainingStep(training.avatar, options=BARE, refinement=corrections)
        background = training.background.to(work.device)

        def step() -> dict[str, torch.Tensor]:
            chosen = training.rows()
            batch = training.frames.batch(chosen)
            position = torch.tensor(chosen, device=work.device)
            shown = TrainingBatch(
                batch.theta, batch.cameras, batch.images_rgba, background, position
            )
            return take(shown, corrections.start_step)

        figures |= _figures(work, take, step)
        moved = float(corrections.frames.theta().sub(theta).abs().max())
        check(figures, moved > 0, "no frame was corrected")


def stream(rows: Rows) -> None:
    """A step on frames that lie in main memory, as a stream's do."""
    work = Workload.here()
    training = Training(work)
    with rows.row("stream") as figures:
        frames, take = training.frames, TrainingStep(training.avatar, options=BARE)
        theta, images = frames.theta.cpu(), torch.as_tensor(frames.images_rgba).cpu()

        def step() -> dict[str, torch.Tensor]:
            chosen = training.rows()
            return take(
                TrainingBatch(
                    theta[chosen].to(work.device),
                    frames.cameras,
                    images[chosen].to(work.device),
                    training.background.to(work.device),
                ),
                0,
            )

        figures |= _figures(work, take, step)


def _figures(work: Workload, take: TrainingStep, step: Step) -> Figures:
    found = work.time(step)
    return {
        "step": f"{take.kind}: {take.reason}",
        "images_per_second": work.batch / found.median,
        "median_ms": 1e3 * found.median,
        "iqr_ms": 1e3 * found.iqr,
    }
