"""`rgbavatar drive`: an avatar moved by a camera, a phone, a film or any program."""

import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rgbavatar_ns.cli.used_options import require_used
from rgbavatar_ns.driving.live_transfer import LiveOptions
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import Between, CheckedOptions, FrameRate, Pixels, Share

if TYPE_CHECKING:
    from rgbavatar_ns.avatar import Avatar
    from rgbavatar_ns.driving.live_drive import DriveOutput, LiveDrive
    from rgbavatar_ns.driving.source import PerformanceSource
    from rgbavatar_ns.export.subject import Subject

Show = Literal["page", "viewer", "none"]
Kind = Literal["arkit", "vmc", "websocket", "CSV file", "dataset", "film", "camera"]
"""What a source is."""
_LISTENING: tuple[Kind, ...] = ("arkit", "vmc", "websocket")
_RECORDED: tuple[Kind, ...] = ("CSV file", "dataset", "film")
"""These have a clock of their own."""
_OF_SOURCES: dict[str, tuple[tuple[Kind, ...], str]] = {
    "beside": (("dataset", "film", "camera"), "sources with pictures"),
    "head-angles": (("arkit", "CSV file"), "arkit and CSV files"),
    "source-frames-per-second": (("CSV file", "dataset"), "CSV files and datasets"),
}
"""What each option counts for, and how that is told."""


@dataclass(frozen=True)
class SourceOptions(CheckedOptions):
    """Who performs, and how they are reached."""

    source: str = "camera"
    """camera (or a camera's number, a device, rtsp://...), a video file or a folder of images, a
    dataset or a run that names one, a CSV file of ARKit curves, arkit (Live Link Face over UDP),
    vmc (OSC), websocket."""
    listen: str | None = None
    """HOST:PORT where arkit (127.0.0.1:11111), vmc (127.0.0.1:39539) or websocket (127.0.0.1:7071)
    wait; a phone needs 0.0.0.0:11111."""
    allow_remote: bool = False
    """Let other machines reach what listens. Nothing is encrypted."""
    source_frames_per_second: FrameRate | None = None
    """Of a dataset (by default the film's own, or 25) or a CSV file (by
    default what its timecodes tell, else 60)."""
    head_angles: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of the head's yaw, pitch and roll from arkit and CSV: -1 mirrors, .01745 is for
    senders of degrees."""
    real_time: bool | None = None
    """Play a recording at its own speed and skip what is late, or each of its frames. By default
    in real time, unless only a film is written."""


@dataclass(frozen=True)
class ShowOptions(CheckedOptions):
    """Where the avatar is seen."""

    show: Show | None = None
    """page (a browser on this machine), viewer (nerfstudio's; needs a run) or none. By default
    page, or none with --out."""
    out: str | None = None
    """A film (film.mp4), - for raw RGB frames on standard output, or a v4l2 loopback device
    (/dev/video10) that OBS and video calls read."""
    beside: bool = False
    """In pictures: the performer beside the avatar."""
    width: Pixels | None = None
    """Width of pictures; the avatar's dataset's, or 512, by default."""
    height: Pixels | None = None
    """Height of pictures, likewise."""
    background: tuple[Share, Share, Share] = (1.0, 1.0, 1.0)
    """Colour behind the head, red, green and blue in [0, 1]."""
    frames_per_second: FrameRate | None = None
    """Of a film and of a virtual camera; 25 by default."""
    serve: str | None = None
    """HOST:PORT of the page and of pages opened with ?ws= (127.0.0.1:7072)."""
    seconds: (
        Annotated[float, Between(0, 1e6, open=True), tyro.conf.arg(metavar="SECONDS")] | None
    ) = None
    """End after so many seconds: of a recording its own, from its first frame (of a film: with a
    face) on, however long they take, else by the clock."""


_SOURCE, _SHOW, _LIVE = SourceOptions(), ShowOptions(), LiveOptions()


def run(
    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    data: Path | None = None,
    source: Annotated[SourceOptions, tyro.conf.arg(name="")] = _SOURCE,
    show: Annotated[ShowOptions, tyro.conf.arg(name="")] = _SHOW,
    live: Annotated[LiveOptions, tyro.conf.arg(name="")] = _LIVE,
) -> None:
    """Drive an avatar live.

    The performer's neutral face is learnt in the first second; c learns it again, q ends. Only
    departures from it move the avatar, so that another person's face drives it as well.

    Args:
        run_folder: a run of ns-train, a checkpoint or an avatar bundle.
        data: the avatar's own dataset; by default the one that the run names.
        source: who performs.
        show: where the avatar is seen.
        live: how the performance becomes the avatar's.
    """
    from rgbavatar_ns.cli.keys import on_keys
    from rgbavatar_ns.driving.live_drive import LiveDrive
    from rgbavatar_ns.driving.live_transfer import LiveTransfer
    from rgbavatar_ns.export.subject import load_subject, told_lost

    shown = show.show or ("none" if show.out else "page")
    if shown == "none" and show.out is None:
        raise UserError("Nothing would be shown.", "Add --out film.mp4, or --show page.")
    _require_shown(shown, show)
    _require_heeded(shown, show, source)
    only_film = shown == "none" and show.out is not None and show.out.endswith(".mp4")
    real_time = not only_film if source.real_time is None else source.real_time
    subject = load_subject(run_folder, data, show.width, show.height, film=False)
    if (lost := told_lost(subject)) is not None:
        _tell(lost)
    beside_px = subject.camera.height if show.beside else None
    performer = _performer(subject, source, real_time, beside_px)
    transfer = LiveTransfer(subject.avatar, subject.seen, performer.head, subject.camera, live)
    if transfer.told:
        _tell(f"note: {transfer.told}")
    outputs: list[DriveOutput] = []
    recorded = _kind(source.source) in _RECORDED
    of_recording, by_clock = (show.seconds, None) if recorded else (None, show.seconds)
    drive = LiveDrive(performer, transfer, outputs, real_time, _tell, of_recording)
    try:
        if shown == "page":
            outputs.append(_page(subject, data, show, source.allow_remote, drive.calibrate))
        if shown == "viewer":
            outputs.append(_viewer(run_folder, drive))
        if show.out is not None:  # The last: nothing is left half-written where another fails.
            outputs.append(_pictures(subject, show))
        with on_keys({"c": drive.calibrate, "q": drive.stop}) as heard:
            _tell("c: learn the neutral face again, q: end." if heard else "Ctrl-C ends.")
            _run(drive, by_clock)
    except BrokenPipeError:
        _tell("The reader of the pictures has gone.")
    finally:
        performer.close()
    left_out = ", ".join(f"{name}: {count}" for name, count in (+performer.counts).items())
    lines = [str(output.latencies) for output in outputs if output.latencies.shown]
    _tell("; ".join([f"{drive.shown} frames", *lines]) + (f" ({left_out})" if left_out else ""))
    if show.out is not None and show.out.endswith(".mp4"):
        _tell(f"The film is {show.out}.")


def _require_shown(shown: Show, show: ShowOptions) -> None:
    """Raise UserError for an option that changes nothing of what is shown."""
    has_rate = show.frames_per_second is not None
    behind = show.out is None and show.background != _SHOW.background
    given = [name for name, it in (("serve", show.serve), ("background", behind)) if it]
    require_used("show", shown, {"serve": ("page",), "background": ("page",)}, given)
    for name, is_given in (("beside", show.beside), ("frames-per-second", has_rate)):
        if is_given and show.out is None:
            raise UserError(
                f"--{name} changes nothing without --out.", "Leave it out, or add --out film.mp4."
            )
    if has_rate and show.out == "-":
        raise UserError(
            "--frames-per-second changes nothing of raw pictures.",
            "Leave it out, or name a film or a device: --out film.mp4.",
        )


def _require_heeded(shown: Show, show: ShowOptions, source: SourceOptions) -> None:
    """Raise UserError for an option of which this source and what is shown know nothing."""
    from rgbavatar_ns.data.streams.address import told_address

    kind, told = _kind(source.source), told_address(source.source)
    if kind in ("film", "camera"):
        _camera(source.source)  # That there is none is worse than an option too many.
    if source.listen is not None and kind not in _LISTENING:
        raise UserError(
            f"The source {told} listens to nobody.", "--listen is for arkit, vmc and websocket."
        )
    if source.allow_remote and kind not in _LISTENING and shown != "page":
        raise UserError(
            "--allow-remote changes nothing where neither a source nor a page listens.",
            "Leave it out, or take --show page.",
        )
    given = {
        "beside": show.beside,
        "head-angles": source.head_angles != _SOURCE.head_angles,
        "source-frames-per-second": source.source_frames_per_second is not None,
    }
    for name, (kinds, used_by) in _OF_SOURCES.items():
        if given[name] and kind not in kinds:
            raise UserError(
                f"--{name} changes nothing of the source {told}.",
                f"Leave it out: it is for {used_by}.",
            )


def _tell(line: str) -> None:
    """To standard error: standard output may carry pictures."""
    print(line, file=sys.stderr, flush=True)


def _run(drive: "LiveDrive", seconds: float | None) -> None:
    """Until the end, q, Ctrl-C or the time is over; films are complete in each case."""
    timer = None if seconds is None else threading.Timer(seconds, drive.stop)
    if timer is not None:
        timer.daemon = True
        timer.start()
    try:
        drive.run()
    except KeyboardInterrupt:
        _tell("Ended.")
    finally:
        if timer is not None:
            timer.cancel()


def _performer(
    subject: "Subject", options: SourceOptions, real_time: bool, image_height_px: int | None
) -> "PerformanceSource":
    """The source that the flags name; raises UserError where there is none."""
    from rgbavatar_ns.driving.source import PerformerHead
    from rgbavatar_ns.driving.sources import live_link_face, vmc, web_socket

    name, listen, remote = options.source, options.listen, options.allow_remote
    if name == "arkit":
        return live_link_face.LiveLinkFaceSource(
            listen or live_link_face.DEFAULT_ADDRESS, remote, options.head_angles
        )
    if name == "vmc":
        return vmc.VmcSource(listen or vmc.DEFAULT_ADDRESS, remote)
    if name == "websocket":
        own = PerformerHead(subject.avatar.layout, subject.avatar.head.arrays)
        if (trouble := web_socket.arkit_trouble(subject.avatar)) is not None:
            _tell(f'Only "theta" moves this avatar, not "arkit": {trouble}')
        address = listen or web_socket.DEFAULT_ADDRESS
        opened = web_socket.WebSocketSource(own, address, remote, trouble)
        keyed = f"from a page of the disk: ws://{opened.keyed_address}"
        _tell(f"Messages are taken at ws://{opened.address} ({keyed})")
        return opened
    path, kind = Path(name).expanduser(), _kind(name)
    if kind == "CSV file":
        from rgbavatar_ns.driving.sources.arkit_csv import csv_source

        rate = options.source_frames_per_second
        return csv_source(path, rate, real_time, options.head_angles)
    if kind == "dataset":
        from rgbavatar_ns.driving.sources.dataset import dataset_source
        from rgbavatar_ns.export import dataset_folder

        rate = options.source_frames_per_second
        return dataset_source(dataset_folder(path), rate, real_time, image_height_px)
    from rgbavatar_ns.tracking.performer import FilmedPerformer

    return FilmedPerformer(_camera(name), real_time, image_height_px)


def _kind(name: str) -> Kind:
    """What a source of this name is; nothing is opened."""
    for listening in _LISTENING:
        if name == listening:
            return listening
    from rgbavatar_ns.tracking.input.capture import is_device

    path = Path(name).expanduser()
    if path.suffix.lower() == ".csv":
        return "CSV file"
    if path.is_dir() and _is_dataset(path):
        return "dataset"
    return "camera" if name == "camera" or is_device(name) else "film"


def _is_dataset(folder: Path) -> bool:
    """Whether the folder is a dataset, or a run that names one; else it is one of images."""
    from rgbavatar_ns.data import is_dataset
    from rgbavatar_ns.export import dataset_folder

    named = dataset_folder(folder)
    return named != folder or is_dataset(named)


def _camera(name: str) -> str:
    from rgbavatar_ns.tracking.input.capture import is_device

    if name == "camera":
        return "0"
    known = is_device(name)
    if not known and not Path(name).expanduser().exists():
        raise UserError(
            f"There is no source {name}.",
            "Name camera, arkit, vmc, websocket, a video, a dataset or a CSV file.",
        )
    return name if known else str(Path(name).expanduser())


def _pictures(subject: "Subject", show: ShowOptions) -> "DriveOutput":
    """A film, raw frames or a virtual camera."""
    from rgbavatar_ns.data.native.dataset import USUAL_FRAMES_PER_SECOND
    from rgbavatar_ns.export import live_pictures

    assert show.out is not None
    rate = show.frames_per_second or USUAL_FRAMES_PER_SECOND
    sink: live_pictures.PictureSink
    if show.out == "-":
        if sys.stdout.isatty():
            raise UserError(
                "Raw pictures would fill the terminal.",
                "Send them on: ... --out - | ffplay -f rawvideo -pixel_format rgb24 "
                "-video_size 512x512 -i -",
            )
        sink = live_pictures.RawSink()
    elif show.out.startswith("/dev/"):
        sink = live_pictures.VirtualCameraSink(show.out, rate)
    elif show.out.endswith(".mp4"):
        sink = live_pictures.FilmSink(Path(show.out), rate)
    else:
        raise UserError(
            f"Pictures cannot go to {show.out}.",
            "Name a film (film.mp4), - for standard output, or a device such as /dev/video10.",
        )
    return live_pictures.PictureOutput(
        subject.avatar, subject.camera, show.background, sink, show.beside
    )


def _page(
    subject: "Subject",
    data: Path | None,
    show: ShowOptions,
    allow_remote: bool,
    calibrate: Callable[[], None],
) -> "DriveOutput":
    """The page, served, and told what moves it."""
    from rgbavatar_ns.avatar.loading import require_rgbavatar
    from rgbavatar_ns.export.live_page import DEFAULT_ADDRESS, PageOutput

    avatar = require_rgbavatar(subject.avatar, "A page (--show page)")
    _tell("The page is being made ...")
    content = _page_content(avatar, subject, data, show)  # Now: nobody who asks has to wait for it.
    output = PageOutput(
        avatar.layout, show.serve or DEFAULT_ADDRESS, allow_remote, lambda: content, calibrate
    )
    _tell(f"Open http://{output.address}/?ws=ws://{output.address}")
    _tell(f"or a page of this avatar (rgbavatar export) with ?ws=ws://{output.keyed_address}")
    return output


def _page_content(
    avatar: "Avatar", subject: "Subject", data: Path | None, show: ShowOptions
) -> bytes:
    """The avatar's page without a performance of its own, calm until it is driven."""
    import torch

    from rgbavatar_ns.export import PageOptions, as_filmed, calm_theta, is_of, write_web_page

    avatar, dataset, seen = avatar.without_undrawn(), subject.dataset, subject.seen
    if dataset is not None and (data is None or is_of(avatar, dataset)):
        avatar = as_filmed(avatar, dataset)
    neutral = calm_theta(seen, seen.theta_mean)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        options = PageOptions(background=show.background, own_server=True)
        nothing = torch.zeros(0, avatar.layout.size)
        write_web_page(avatar, path, subject.camera, nothing, options, seen, neutral)
        return path.read_bytes()


def _viewer(run_folder: Path, drive: "LiveDrive") -> "DriveOutput":
    from rgbavatar_ns.plugin.live_viewer import ViewerOutput

    output = ViewerOutput(run_folder, drive.calibrate)
    _tell(f"Open {output.address}")
    return output
