"""`rgbavatar demo`: from nothing (or from a video) to a trained avatar, through nerfstudio."""

import shutil
import time
from pathlib import Path
from typing import Annotated, Any

from rgbavatar_ns.avatar.storage.checkpoint_file import CONFIG_NAME
from rgbavatar_ns.cli.console import command_line, plain_console
from rgbavatar_ns.cli.progress import progress_bar, stage_bars
from rgbavatar_ns.cli.track import suited_method
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.experiments import commands
from rgbavatar_ns.files import Stages, write_json
from rgbavatar_ns.options import Between, Count, Seed

Result = dict[str, Any]
TINY = "rgbavatar-tiny"
HELD_OUT_STEPS, HELD_OUT_FRAMES = 40, 24
"""Steps of fitting a video's held-out frames, for the score that looks at their images, and how
many at most are fitted."""

_FRAMES = 240
_TINY_PX = 256
"""Pixels of a small avatar's images."""


def run(
    output: Path | None = None,
    video: tuple[Path, ...] = (),
    frames: Annotated[int, Between(2, 100_000)] | None = None,
    image_size: Annotated[int, Between(16, 4096)] | None = None,
    head_only: bool = False,
    tiny: bool = False,
    steps: Count | None = None,
    seed: Seed = 0,
    fresh: bool = False,
    started_at: float | None = None,
) -> None:
    """Make or track a head, train its avatar with ns-train, evaluate it, film it.

    Args:
        output: where everything is written; outputs/demo, or outputs/NAME for NAME.mp4.
        video: your own video (several clips of one person may be given) in place of the demo
            subject.
        frames: frames of the demo subject, 240 by default; its last quarter is held out.
        image_size: width and height of the images in pixels; by default 256, and up to 512
            of a video that has as many.
        head_only: track the head of a video without its body.
        tiny: for a slow machine, an avatar of a quarter of the Gaussians from images of 256 pixels
            of your video, in three quarters of the time; the demo subject's is always so.
        steps: training steps, over which the learning rates fall; by default those of the method:
            rgbavatar-quick where images of a video have 400 pixels or more, else rgbavatar-tiny.
        seed: of the demo subject and of the training.
        fresh: do every stage again, also those that are done.
        started_at: Unix time from which total_seconds counts; now by default.
    """
    started_at = time.time() if started_at is None else started_at
    for clip in video:
        if not clip.exists():
            raise UserError(f"There is no video {clip}.", "Check the path given with --video.")
    if output is None:
        output = Path("outputs") / (video[0].stem if video else "demo")
    output = output.resolve()
    stages = Stages(output, fresh=fresh, tell=_tell_stage)
    _require_counting(bool(video), head_only, frames)
    _require_same_people(stages, video, output)
    commands.require_program("ns-train")  # now, not after minutes of tracking
    if video:
        if tiny and image_size is None:
            image_size = _TINY_PX
        _require_same_tracking(stages, image_size, head_only, output)
        settings: dict[str, Any] = {"video": [_fingerprint(clip) for clip in video]}
        settings |= {"image_size": image_size, "head_only": head_only}
        data = stages.run(
            "track",
            settings,
            lambda key: _track(video, output / "data", image_size, head_only),
        )
    else:
        settings = {"frames": frames or _FRAMES, "image_size": image_size or _TINY_PX, "seed": seed}
        data = stages.run("demo subject", settings, lambda key: _demo(output / "data", settings))
    folder = Path(data["data"])
    method = TINY if tiny else suited_method(data.get("image_size", 0))
    trained = stages.run(
        "train",
        {"method": method, "steps": steps, "seed": seed, "refine_tracking": bool(video)},
        lambda key: _train(
            *(folder, output, key, method, steps, seed), refine_tracking=bool(video), anew=fresh
        ),
    )
    run_folder = Path(trained["run"])
    scores = stages.run(
        "evaluate", {}, lambda key: commands.evaluate(run_folder, output / "eval.json")
    )
    shown = stages.run("film", {}, lambda key: _film(run_folder, folder, output))
    summary = {
        "psnr": scores["psnr"],
        "psnr_head": scores["psnr_head"],
        "psnr_head_refined": scores.get("psnr_head_refined"),
        "ssim": scores["ssim"],
        "lpips_vgg": scores.get("lpips_vgg"),
        "train_seconds": trained["train_seconds"],
        "images_per_second": trained["images_per_second"],
        "total_seconds": time.time() - started_at,
        "stage_seconds": stages.seconds,
        "held_out_frames": shown["frames"],
        "run": str(run_folder),
        "data": str(folder),
        "video": shown["video"],
        "picture": shown["picture"],
    }
    write_json(output / "summary.json", summary)
    _tell(summary, output)


def _require_counting(filmed: bool, head_only: bool, frames: int | None) -> None:
    """Raise UserError for an option that changes nothing of a video or of the demo subject."""
    if filmed and frames is not None:
        raise UserError("--frames changes nothing of a --video.", "Leave it out.")
    if head_only and not filmed:
        raise UserError("--head-only changes nothing without a --video.", "Leave it out.")


def _require_same_people(stages: Stages, video: tuple[Path, ...], output: Path) -> None:
    """Raise UserError where the folder has the avatar of somebody else, which reads its data."""
    films = (stages.known("track") or {}).get("films")
    other = None
    if films is not None and films != [str(clip.resolve()) for clip in video]:
        other = f"another film, {', '.join(films)}"
    elif video and stages.known("demo subject") is not None:
        other = "the demo subject"
    if other is not None:
        raise UserError(
            f"{output} has the avatar of {other}.",
            "Name another folder (--output), or replace that avatar (--fresh).",
        )


def _require_same_tracking(
    stages: Stages, image_size: int | None, head_only: bool, output: Path
) -> None:
    """Raise UserError where an avatar was trained on the film as other options track it."""
    asked = (stages.known("track") or {}).get("asked")
    given = _asked(image_size, head_only)
    if asked is None or asked == given or stages.known("train") is None:
        return
    raise UserError(
        f"{output} has an avatar of this film, and its data, tracked with other options "
        f"({_in_words(asked)}; now {_in_words(given)}).",
        "Name another folder (--output), or replace that avatar (--fresh).",
    )


def _asked(image_size: int | None, head_only: bool) -> Result:
    """The options of tracking, to be known again."""
    return {"image_size": image_size, "head_only": head_only}


def _in_words(asked: Result) -> str:
    size = asked["image_size"]
    pixels = "the film's own pixels" if size is None else f"{size} pixels"
    return f"{pixels}, the head alone" if asked["head_only"] else pixels


def _fingerprint(path: Path) -> tuple[str | int | float, ...]:
    from rgbavatar_ns.tracking.input.image_files import source_digest

    if path.is_dir():  # Its own size and time stay where an image in it is replaced.
        return str(path.resolve()), source_digest(path)
    facts = path.stat()
    return str(path.resolve()), facts.st_size, facts.st_mtime


def _demo(destination: Path, settings: dict[str, Any]) -> Result:
    from rgbavatar_ns.synthetic import DemoConfig, make_demo_dataset

    config = DemoConfig(
        num_frames=settings["frames"],
        num_test_frames=max(1, settings["frames"] // 4),
        image_size=settings["image_size"],
        seed=settings["seed"],
    )
    with progress_bar("demo subject") as update:
        make_demo_dataset(destination, config, progress=update, overwrite=True)
    return {"data": str(destination)}


def _track(
    video: tuple[Path, ...], destination: Path, image_size: int | None, head_only: bool
) -> Result:
    from rgbavatar_ns.tracking import TrackConfig, track_video

    # What an interrupted run has done is gone on with.
    config = TrackConfig(image_size=image_size, head_only=head_only, overwrite=True)
    with stage_bars("frames") as update:
        dataset = track_video(video, destination, config, progress=update)
    films = [str(clip.resolve()) for clip in video]
    asked = _asked(image_size, head_only)
    return {
        "data": str(destination),
        "image_size": dataset.width,
        "films": films,
        "asked": asked,
    }


def _train(
    data: Path,
    output: Path,
    key: str,
    method: str,
    steps: int | None,
    seed: int,
    *,
    refine_tracking: bool,
    anew: bool,
) -> Result:
    # Where ns-train puts an experiment of this name: what takes a run takes `output` too.
    run_folder = output / method / key
    # Else a run of the same settings would be gone on with, also one of other frames.
    if anew or _is_older(run_folder / "config.yml", data / "dataset.json"):
        shutil.rmtree(run_folder, ignore_errors=True)
    options: list[str] = []
    if refine_tracking:
        options += ["--pipeline.model.refine-tracking", "True"]
        options += ["--pipeline.model.refine-held-out", str(HELD_OUT_STEPS)]
        options += ["--pipeline.model.refine-held-out-frames", str(HELD_OUT_FRAMES)]
    if steps is not None:
        options += ["--max-num-iterations", str(steps), "--learning-rate-steps", str(steps)]
    facts = commands.train(method, data, run_folder, seed, options)
    return {
        "run": str(run_folder),
        "train_seconds": facts["train_seconds"],
        "images_per_second": facts["images_per_second"],
    }


def _is_older(path: Path, other: Path) -> bool:
    both_there = path.exists() and other.exists()
    return both_there and path.stat().st_mtime < other.stat().st_mtime


def _film(run_folder: Path, data: Path, output: Path) -> Result:
    from rgbavatar_ns.avatar.loading import load_avatar
    from rgbavatar_ns.data import load_dataset
    from rgbavatar_ns.export import as_trained_on, write_comparison

    video, picture = output / "comparison.mp4", output / "comparison.png"
    avatar = load_avatar(run_folder)
    dataset = as_trained_on(avatar, run_folder, load_dataset(data), data)
    count = write_comparison(avatar, dataset, video, picture)
    return {"video": str(video), "picture": str(picture), "frames": count}


def _tell_stage(name: str, seconds: float | None) -> None:
    console = plain_console()
    if seconds is None:
        console.rule(name)
    else:
        console.print(f"{name}: done before ({seconds:.0f} s)", style="dim")


def _tell(summary: dict[str, Any], output: Path) -> None:
    """Print where things are, the metrics and how to open the viewer."""
    lpips, run_folder = summary["lpips_vgg"], Path(summary["run"])
    rows = {
        "held-out PSNR": f"{summary['psnr']:.2f} dB over {summary['held_out_frames']} frames",
        "of the head": f"{summary['psnr_head']:.2f} dB",
        "held-out SSIM": f"{summary['ssim']:.4f}",
        "training": f"{summary['train_seconds']:.0f} s, "
        f"{summary['images_per_second']:.0f} images/s",
        "picture": summary["picture"],
        "film": summary["video"],
        "figures": str(output / "summary.json"),
        "viewer": _command("ns-viewer", "--load-config", run_folder / CONFIG_NAME),
        "drive it": _command("rgbavatar", "drive", run_folder),
        "web page": _command(
            "rgbavatar", "export", run_folder, output / "me.html", "--format", "web"
        ),
    }
    if summary["psnr_head_refined"] is not None:
        fitted = min(HELD_OUT_FRAMES, summary["held_out_frames"])
        rows["head, fitted"] = (
            f"{summary['psnr_head_refined']:.2f} dB, pose fitted to each of {fitted} images"
        )
    if lpips is not None:
        rows["held-out LPIPS"] = f"{lpips:.4f} (VGG)"
    console = plain_console()
    console.rule("done")
    for name, value in rows.items():
        console.print(f"{name:<15} {value}")


def _command(program: str, *words: str | Path) -> str:
    """Of this environment."""
    return command_line(commands.find_program(program) or program, *words)
