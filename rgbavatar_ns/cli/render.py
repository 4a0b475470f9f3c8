"""`rgbavatar render`: films and pictures of a trained avatar."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rgbavatar_ns.cli.progress import progress_bar
from rgbavatar_ns.cli.used_options import require_used
from rgbavatar_ns.driving.transfer import DrivingOptions
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Between, CheckedOptions, Counted, FrameRate, Pixels, Share, Weight

if TYPE_CHECKING:
    import numpy as np

    from rgbavatar_ns.data import TrackedDataset
    from rgbavatar_ns.export.scenes import Scene
    from rgbavatar_ns.export.subject import Subject

Show = Literal["comparison", "performance", "views", "orbit", "camera-path", "turntable", "bases"]
Kind = Literal["mp4", "png", "gif"]
_OF_A_SCENE: tuple[Show, ...] = ("performance", "views", "orbit", "camera-path", "turntable")
_USED_BY: dict[str, tuple[Show, ...]] = {
    **dict.fromkeys(("driver", "hold", "kind"), _OF_A_SCENE),
    "transparent": (*_OF_A_SCENE, "bases"),
    **dict.fromkeys(("width", "height"), ("performance", "views", "orbit", "turntable", "bases")),
    "frames": ("comparison", *_OF_A_SCENE),
    "frames-per-second": ("comparison", "performance", "views", "orbit", "turntable"),
    "camera-path": ("camera-path",),
    "gain": ("bases",),
    "arc": ("turntable",),
}
"""What each option counts for."""


@dataclass(frozen=True)
class PictureOptions(CheckedOptions):
    """Size, background and kind of what is written."""

    kind: Kind | None = None
    """mp4, png (numbered pictures) or gif; mp4 by default, gif for the turntable."""
    width: Pixels | None = None
    """Width of the avatar's picture in pixels; the dataset's by default."""
    height: Pixels | None = None
    """Height of the avatar's picture in pixels; the dataset's by default."""
    background: tuple[Share, Share, Share] = (1.0, 1.0, 1.0)
    """Colour behind the head, red, green and blue in [0, 1]."""
    transparent: bool = False
    """No background: PNG files keep the alpha."""
    frames_per_second: FrameRate | None = None
    """Of the film (along a camera path: the path's), and of the performance for smoothing; by
    default the performance's own, or 25 where that is not known."""

    def kind_for(self, show: Show) -> Kind:
        """What is written; raises UserError for a film that would lose its alpha."""
        kind = self.kind or ("gif" if show == "turntable" else "mp4")
        if self.transparent and kind != "png":
            raise UserError(f"A transparent {kind} cannot be written.", "Add --kind png.")
        return kind


_PICTURE, _DRIVING = PictureOptions(), DrivingOptions()


def run(
    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUTPUT")],
    data: Path | None = None,
    show: Show = "comparison",
    driver: Path | None = None,
    frames: tuple[int, int] | None = None,
    hold: Counted | None = None,
    camera_path: Path | None = None,
    gain: Weight | None = None,
    arc: Annotated[float, Between(-360, 360)] | None = None,
    texture: Path | None = None,
    picture: Annotated[PictureOptions, tyro.conf.arg(name="")] = _PICTURE,
    driving: Annotated[DrivingOptions, tyro.conf.arg(name="")] = _DRIVING,
) -> None:
    """Write films and pictures of an avatar to the folder OUTPUT.

    comparison: held-out frames, avatar and error (times 4) side by side. performance: the avatar
    alone, or with --driver beside the other person who drives it. views: four fixed views in a
    row. orbit: the camera swings around the head. camera-path: the cameras of nerfstudio's viewer.
    turntable: the camera goes to and fro about the head. Views, orbit and turntable show the head
    no more than 30 degrees beyond what was filmed; what goes beyond the film is told. bases: each
    learned basis alone, made strong enough to be seen, beside what it changes.

    Args:
        run_folder: a run of ns-train, a checkpoint or an avatar bundle.
        output: the folder to write to.
        data: the avatar's own dataset; by default the one that the run names. A bundle that holds
            training statistics needs none: it is seen at rest from the front, or driven.
        show: what to show.
        driver: another dataset, or a run that names its dataset, whose performance drives the
            avatar.
        frames: the first frame of the performance and the one after the last; by default all of
            the driver's frames, or the held-out ones of the avatar's own dataset.
        hold: show the expression of this one of the chosen frames, instead of playing them.
        camera_path: for camera-path, the JSON file saved in the viewer's render panel.
        arc: for the turntable, how far around the head in degrees, whatever was filmed; less than
            360 goes to and fro.
        gain: for bases, by how much each basis's largest weight in training is exaggerated; by
            default by as much as it takes to see what it does.
        texture: a PNG painted over what `rgbavatar export --format texture` wrote of this avatar:
            its colours change as it was changed.
        picture: how pictures are written.
        driving: how the driver's performance becomes the avatar's.
    """
    if driver is not None and show == "comparison":
        show = "performance"
    given = {"driver": driver, "frames": frames, "hold": hold, "camera-path": camera_path}
    smoothed = driver is not None and driving.smooth
    _require_counting(show, given | {"gain": gain, "arc": arc}, picture, smoothed)
    if driver is None and driving != _DRIVING:
        raise UserError(
            "There are options of driving, but nobody drives the avatar.",
            "Name who does with --driver, or leave them out.",
        )
    from rgbavatar_ns.avatar.loading import require_rgbavatar
    from rgbavatar_ns.export import read_texture, with_texture
    from rgbavatar_ns.export.subject import load_subject, told_lost

    subject = load_subject(run_folder, data, picture.width, picture.height, film=driver is None)
    if (lost := told_lost(subject)) is not None:
        print(lost)
    if texture is not None:
        own = require_rgbavatar(subject.avatar, "A painted texture (--texture)")
        subject = replace(subject, avatar=with_texture(own, read_texture(texture)))
    if show == "comparison":
        _compare(subject, output, frames, picture)
    elif show == "bases":
        _write_bases(subject, output, gain, picture)
    else:
        kind = picture.kind_for(show)
        scene, beside = _scene(subject, driver, frames, picture, driving)
        scene, drawn = _drawn(subject, scene, beside, show, hold, arc, camera_path, picture)
        _write(drawn, len(scene), output, show, kind, scene.frames_per_second)


def _require_counting(
    show: Show, options: Mapping[str, object], picture: PictureOptions, smoothed: bool
) -> None:
    """Raise UserError for an option that changes nothing of what is shown."""
    given = {**options, **vars(picture)}
    rate = given.pop("frames_per_second")
    # Smoothing goes by the rate, whatever is written.
    given["frames-per-second"] = None if smoothed else rate
    named = [name for name, value in given.items() if value is not None and value is not False]
    require_used("show", show, _USED_BY, named)
    require_used("kind", picture.kind or "mp4", {"frames-per-second": ("mp4", "gif")}, named)
    if picture.transparent and picture.background != _PICTURE.background:
        raise UserError("--background changes nothing of --transparent.", "Leave one of them out.")


def _compare(
    subject: "Subject", output: Path, frames: tuple[int, int] | None, picture: PictureOptions
) -> None:
    from rgbavatar_ns.export import write_comparison
    from rgbavatar_ns.export.scenes import chosen_frames

    dataset = subject.dataset
    if dataset is None:
        raise UserError("A comparison needs the avatar's own dataset.", "Name it with --data.")
    chosen = None if frames is None else chosen_frames(len(dataset), frames, dataset.test)
    video, still = output / "comparison.mp4", output / "comparison.png"
    with progress_bar("comparison") as update:
        count = write_comparison(
            subject.avatar,
            dataset,
            video,
            still,
            chosen,
            frames_per_second=picture.frames_per_second,
            background=picture.background,
            progress=update,
        )
    print(f"{count} frames: {video} and {still}")


def _write_bases(
    subject: "Subject", output: Path, gain: float | None, picture: PictureOptions
) -> None:
    from rgbavatar_ns.avatar.loading import require_rgbavatar
    from rgbavatar_ns.export import basis_grid, write_png

    avatar = require_rgbavatar(subject.avatar, "The grid of bases (--show bases)")
    background = None if picture.transparent else picture.background
    with progress_bar("bases") as update:
        grid = basis_grid(avatar, subject.seen, subject.camera, background, gain, update)
    write_png(output / "bases.png", grid)
    print(f"base and {avatar.config.num_bases} bases: {output / 'bases.png'}")


def _scene(
    subject: "Subject",
    driver: Path | None,
    frames: tuple[int, int] | None,
    picture: PictureOptions,
    driving: DrivingOptions,
) -> "tuple[Scene, tuple[TrackedDataset, tuple[int, ...]] | None]":
    """The performance seen by the avatar's own camera, and the driver's frames if there is one."""
    from rgbavatar_ns.data import load_dataset
    from rgbavatar_ns.export import dataset_folder
    from rgbavatar_ns.export.scenes import Scene, chosen_frames, driven_by

    if driver is None:
        return _own_scene(subject, frames, picture), None
    other = load_dataset(dataset_folder(driver))
    rate = picture.frames_per_second or other.playback_rate
    chosen = chosen_frames(len(other), frames, other.of_one_camera(range(len(other))))
    mapped = driven_by(subject.avatar, other, chosen, subject.seen, rate, driving)
    if mapped.told:
        print(mapped.told)
    if mapped.unmapped:
        print(f"not known to the avatar, left out: {', '.join(mapped.unmapped)}")
    if mapped.missing:
        print(f"not known to the driver, left at rest: {', '.join(mapped.missing)}")
    return Scene(mapped.theta, subject.camera, rate), (other, chosen)


def _own_scene(
    subject: "Subject", frames: tuple[int, int] | None, picture: PictureOptions
) -> "Scene":
    """The avatar's own film, or its neutral face where there is none."""
    from rgbavatar_ns.data.native.dataset import USUAL_FRAMES_PER_SECOND
    from rgbavatar_ns.export import resized
    from rgbavatar_ns.export.scenes import Scene, chosen_frames

    camera, dataset = subject.camera, subject.dataset
    if dataset is None:
        if frames is not None:
            raise UserError("Frames are those of a dataset.", "Name it with --data or --driver.")
        rate = picture.frames_per_second or USUAL_FRAMES_PER_SECOND
        return Scene(subject.seen.theta_neutral[None], camera, rate)
    film = dataset.of_one_camera(dataset.test or dataset.train)
    chosen = chosen_frames(len(dataset), frames, film)
    cameras = resized(dataset.cameras.select(chosen), camera.width, camera.height)
    rate = picture.frames_per_second or dataset.playback_rate
    return Scene(dataset.theta[list(chosen)], cameras, rate)


def _drawn(
    subject: "Subject",
    scene: "Scene",
    beside: "tuple[TrackedDataset, tuple[int, ...]] | None",
    show: Show,
    hold: int | None,
    arc: float | None,
    camera_path: Path | None,
    picture: PictureOptions,
) -> "tuple[Scene, Iterator[np.ndarray]]":
    """What is shown, frame by frame, and its pictures."""
    from rgbavatar_ns.data.native.dataset import USUAL_FRAMES_PER_SECOND
    from rgbavatar_ns.export import pictures, scenes

    avatar, seen = subject.avatar, subject.seen
    background = None if picture.transparent else picture.background
    one_picture = show == "orbit" and len(scene) == 1
    if hold is not None or show == "turntable" or one_picture:
        moving = show in ("orbit", "turntable")
        scene = scene.held(hold or 0, scenes.TURNTABLE_FRAMES if moving else 1)
        if moving:  # The camera is all that moves, and does not care for the film's rate.
            rate = picture.frames_per_second or USUAL_FRAMES_PER_SECOND
            scene = replace(scene, frames_per_second=rate)
        elif beside is not None:
            other, chosen = beside
            beside = other, (chosen[hold or 0],)
    views = scenes.four_views(avatar, scene, seen) if show == "views" else None
    if show == "orbit":
        scene = scenes.orbiting(avatar, scene, seen)
    elif show == "turntable":
        scene = scenes.turntable(avatar, scene, seen, arc)
    elif show == "camera-path":
        if camera_path is None:
            raise UserError("There is no camera path.", "Name its file with --camera-path.")
        scene = scenes.along_path(camera_path, scene)
    drawn, what = (scene, "pictures") if views is None else (views, "views")
    if told := scenes.told_beyond_film(avatar, drawn, seen, what):
        print(told)
    if views is not None:
        return scene, scenes.side_by_side(avatar, views, background)
    if show == "performance" and beside is not None and background is not None:
        return scene, scenes.beside_driver(avatar, scene, *beside, background)
    return scene, pictures(avatar, scene.theta, scene.cameras, background)


def _write(
    drawn: "Iterator[np.ndarray]",
    total: int,
    output: Path,
    show: Show,
    kind: Kind,
    frames_per_second: float,
) -> None:
    from rgbavatar_ns.export import write_gif, write_pngs, write_video

    place = output / (show if kind == "png" else f"{show}.{kind}")
    with progress_bar(show) as update:
        counted = _counted(drawn, total, update)
        if kind == "png":
            count = write_pngs(place, counted)
        else:
            write_film = write_gif if kind == "gif" else write_video
            count = write_film(place, counted, frames_per_second)
    print(f"{count} pictures: {place}")


def _counted(
    frames: "Iterable[np.ndarray]", total: int, update: Callable[[int, int], None]
) -> "Iterator[np.ndarray]":
    for done, frame in enumerate(frames, start=1):
        yield frame
        update(done, total)
