"""`rgbavatar export`: the avatar for other programs and other people."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rgbavatar_ns.cli.progress import progress_bar
from rgbavatar_ns.cli.used_options import require_used
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import FrameRate

if TYPE_CHECKING:
    from rgbavatar_ns.avatar import Avatar
    from rgbavatar_ns.avatar.method import AvatarMethod
    from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
    from rgbavatar_ns.data import TrackedDataset
    from rgbavatar_ns.export import PageOptions

Format = Literal[
    "bundle", "ply", "gltf", "spz", "compressed-ply", "sog", "texture", "web", "web-module"
]
_GAUSSIANS: tuple[Format, ...] = ("ply", "gltf", "spz", "compressed-ply", "sog")
_BROWSERS: tuple[Format, ...] = ("web", "web-module")
_USED_BY: dict[str, tuple[Format, ...]] = {
    "frame": _GAUSSIANS,
    "frames": (*_GAUSSIANS, *_BROWSERS),
    "no-head-inside": ("bundle",),
    **dict.fromkeys(("no-performance", "frames-per-second"), _BROWSERS),
    **dict.fromkeys(("title", "origins", "servers"), ("web",)),
}
"""What each option counts for."""
_ENDINGS: dict[str, Format] = {
    ".compressed.ply": "compressed-ply",
    ".ply": "ply",
    ".glb": "gltf",
    ".spz": "spz",
    ".sog": "sog",
    ".html": "web",
    ".png": "texture",
}
"""What a destination's ending asks for, the longer ones first."""
_SUCH_AS: dict[Format, str] = {format: f"avatar{ending}" for ending, format in _ENDINGS.items()}
_NOT_WRITTEN = (
    *(".gltf", ".splat", ".ksplat", ".spx", ".lcc"),
    *(".obj", ".fbx", ".stl", ".usd", ".usda", ".usdc", ".usdz", ".blend", ".vrm"),
    *(".zip", ".tar", ".gz", ".7z", ".ckpt", ".pt", ".pth", ".npz", ".safetensors", ".json"),
    *(".jpg", ".jpeg", ".webp", ".gif", ".mp4", ".mov", ".webm", ".htm", ".js", ".rgba"),
)
"""Endings of other files: who asks for one does not want a bundle's folder of that name."""
_LONGEST_SECONDS = 30.0
"""Of a performance that nobody chose: a minute of film would double the size of a page."""


def run(
    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    destination: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")],
    format: Format | None = None,
    data: Path | None = None,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    head_inside: bool = True,
    texture: Path | None = None,
    performance: bool = True,
    frames_per_second: FrameRate | None = None,
    title: str | None = None,
    origins: tuple[str, ...] = (),
    servers: tuple[str, ...] = (),
) -> None:
    """Write an avatar as a bundle, as Gaussians for other programs, as a picture or for browsers.

    bundle: a folder that `Avatar.load` opens without nerfstudio, with what the avatar saw in
    training. ply, gltf, spz, compressed-ply, sog: the Gaussians of one frame, or a folder of
    several frames' (--frames), as viewers of 3D Gaussian splatting open them. All these can be had
    of other methods' avatars too. texture: the head's colours as a picture to paint on, for
    --texture. web: one HTML file that plays and drives the avatar in a browser, without a server or
    a network. web-module: a folder with the avatar's file, an ES module that shows and drives it on
    a canvas of your own page, and examples.

    Args:
        run_folder: a run of ns-train, a checkpoint or an avatar bundle.
        destination: the file to write; for bundle and web-module, and with --frames of Gaussians,
            the folder.
        format: what to write; by default what the destination's ending says (.ply, .glb, .spz,
            .sog, .compressed.ply, .html, .png), or a bundle where it has no file's ending.
        data: the dataset whose frames are meant; by default the one that the run names.
        frame: of Gaussians, the frame's place in the dataset; without it the head is at rest.
        frames: of Gaussians and for browsers, first frame and the frame after the last one; by
            default, for browsers, the first 30 seconds of the run's own film. A folder of Gaussians
            then holds these frames alone.
        head_inside: for bundle, put the head model inside. Without it the bundle only names its
            head model, as the licence of FLAME asks where it is passed on.
        texture: a PNG painted over what --format texture wrote of this avatar: its colours change
            as it was changed.
        performance: for browsers, whether the avatar brings those frames to play.
        frames_per_second: for browsers, of the performance; by default the film's own, or 25 where
            that is not known.
        title: for web, the page's title, "Avatar" by default.
        origins: for web, other pages whose messages it takes, such as https://example.org.
        servers: for web, what may drive it by ?ws= beside this machine, such as wss://example.org.
    """
    from rgbavatar_ns.avatar.loading import load_avatar, require_rgbavatar
    from rgbavatar_ns.export import GAUSSIAN_FILES, read_texture, with_texture

    format = _format_of(destination, format)
    given = {
        "frame": frame is not None,
        "frames": frames is not None,
        "no-head-inside": not head_inside,
        "no-performance": not performance,
        "frames-per-second": frames_per_second is not None,
        "title": title is not None,
        "origins": bool(origins),
        "servers": bool(servers),
    }
    require_used("format", format, _USED_BY, [name for name, is_given in given.items() if is_given])
    _require_place(destination, format, in_a_folder=frames is not None)
    whole = load_avatar(run_folder)
    if texture is not None:
        own = require_rgbavatar(whole, "A painted texture (--texture)")
        whole = with_texture(own, read_texture(texture))
    avatar = _without_undrawn(whole)
    dataset = _dataset(avatar, run_folder, data, needed=frame is not None or frames is not None)
    if format == "bundle":
        seen = _seen(avatar, dataset)
        avatar.save(destination, statistics=seen, with_head=head_inside)
        print(f"{type(avatar).__name__}.load({str(destination)!r}) opens it.")
    elif format in GAUSSIAN_FILES:
        _write_gaussians(avatar, dataset, format, frame, frames, destination)
    elif format == "texture":
        _write_texture(require_rgbavatar(avatar, "--format texture"), destination)
    else:
        from rgbavatar_ns.export import PageOptions, is_of

        own = require_rgbavatar(avatar, f"--format {format}")
        rate = frames_per_second or _rate_of(dataset)
        options = PageOptions(title or "Avatar", rate, origins=origins, servers=servers)
        seen = _seen(avatar, dataset)
        if dataset is not None and (data is None or is_of(avatar, dataset)):
            own = _as_filmed(own, dataset)
        places = page_frames(dataset, frames, rate)
        _write_web(format, own, seen, dataset, places, performance, destination, options)


def _format_of(destination: Path, format: Format | None) -> Format:
    """The format, or what the destination's ending asks for; a bundle where it asks for nothing.

    Raises UserError where the ending asks for another file than the format's: other programs go by
    the ending.
    """
    name = destination.name.lower()
    for ending, asked in _ENDINGS.items():
        if name.endswith(ending):
            if format is None:
                return asked
            if Path(_SUCH_AS.get(format, "")).suffix != destination.suffix.lower():
                raise UserError(
                    f"{destination} asks for --format {asked}, and --format {format} is given.",
                    "Leave out --format, or name a file or folder with another ending.",
                )
    if format is not None:
        return format
    if name.endswith(_NOT_WRITTEN):
        raise UserError(
            f"{destination} asks for a {destination.suffix.lower()} file, which is not written.",
            f"Take {', '.join(_ENDINGS)} or no ending, or say by --format what is to be written.",
        )
    return "bundle"


def _require_place(destination: Path, format: Format, *, in_a_folder: bool) -> None:
    """Raise UserError where a file is to be written in the place of a folder, before any work."""
    is_folder = format in ("bundle", "web-module") or (in_a_folder and format in _GAUSSIANS)
    if not is_folder and destination.is_dir():
        raise UserError(
            f"{destination} is a folder, but --format {format} writes a file.",
            f"Name a file, such as {destination / _SUCH_AS[format]}.",
        )


def _rate_of(dataset: "TrackedDataset | None") -> float:
    """At which the film is shown."""
    from rgbavatar_ns.data.native.dataset import USUAL_FRAMES_PER_SECOND

    return USUAL_FRAMES_PER_SECOND if dataset is None else dataset.playback_rate


def _without_undrawn(whole: "AvatarMethod") -> "AvatarMethod":
    """An RGBAvatar without the Gaussians that show in no picture, which is told; others whole."""
    from rgbavatar_ns.avatar import Avatar

    if not isinstance(whole, Avatar):
        return whole
    avatar = whole.without_undrawn()
    if (left_out := whole.num_gaussians - avatar.num_gaussians) > 0:
        print(f"{left_out} of {whole.num_gaussians} Gaussians show in no picture: left out.")
    return avatar


def _seen(avatar: "AvatarMethod", dataset: "TrackedDataset | None") -> "TrainingStatistics | None":
    """What the avatar saw in training, by itself or by the dataset, if that is known."""
    from rgbavatar_ns.export import statistics_of

    known = avatar.training_statistics
    return known if known is not None or dataset is None else statistics_of(avatar, dataset)


def _dataset(
    avatar: "AvatarMethod", run_folder: Path, data: Path | None, *, needed: bool
) -> "TrackedDataset | None":
    """The named dataset, or the run's own, which has the theta that the avatar was trained on.

    None where there is none and none is needed.
    """
    from rgbavatar_ns.data import load_dataset
    from rgbavatar_ns.export import as_trained_on, dataset_folder

    folder = dataset_folder(run_folder) if data is None else data
    if data is None and folder == run_folder:
        if needed:
            raise UserError("Frames are those of a dataset.", "Name it with --data.")
        return None
    try:
        dataset = load_dataset(folder)
        avatar.require_layout(dataset.layout, f"The dataset {folder}")
        return as_trained_on(avatar, run_folder, dataset, folder)
    except UserError as error:
        if data is not None or needed:
            raise
        print(f"note: {error.cause} It goes without the frames of the run's own data.")
        return None


def _write_gaussians(
    avatar: "AvatarMethod",
    dataset: "TrackedDataset | None",
    format: Format,
    frame: int | None,
    frames: tuple[int, int] | None,
    destination: Path,
) -> None:
    import torch

    from rgbavatar_ns.export import write_gaussian_sequence, write_gaussians
    from rgbavatar_ns.export.scenes import chosen_frames

    if frame is not None and frames is not None:
        raise UserError("There is both --frame and --frames.", "Leave one of them out.")
    if dataset is None or (frame is None and frames is None):
        count = write_gaussians(avatar, torch.zeros(1, avatar.layout.size), destination, format)
        print(f"{count} Gaussians in {destination}")
    elif frames is None and frame is not None:
        (place,) = chosen_frames(len(dataset), (frame, frame + 1), ())
        count = write_gaussians(avatar, dataset.theta[[place]], destination, format)
        print(f"{count} Gaussians in {destination}")
    else:
        chosen = chosen_frames(len(dataset), frames, ())
        with progress_bar(format) as update:
            write_gaussian_sequence(avatar, dataset.theta, chosen, destination, format, update)
        print(f"{len(chosen)} files in {destination}")


def _write_texture(avatar: "Avatar", destination: Path) -> None:
    from rgbavatar_ns.export import write_texture

    wires = write_texture(destination, avatar)
    print(f"{destination}: paint on it, the face is upright and its left side on the right.")
    print(f"{wires}: the head's mesh, to lay over it. --texture takes the painted picture.")


def _as_filmed(avatar: "Avatar", dataset: "TrackedDataset") -> "Avatar":
    """The avatar without what lies beyond the film's edges, which is told."""
    from rgbavatar_ns.export import as_filmed

    filmed = as_filmed(avatar, dataset)
    if (left_out := avatar.num_gaussians - filmed.num_gaussians) > 0:
        print(f"{left_out} Gaussians lie beyond every picture's edge: left out.")
    return filmed


def page_frames(
    dataset: "TrackedDataset | None", frames: tuple[int, int] | None, frames_per_second: float
) -> tuple[int, ...]:
    """Places of the frames that a page plays: those named, or the film's beginning.

    Of several cameras the first one's film: the others saw the same.
    """
    from rgbavatar_ns.export.scenes import chosen_frames

    if dataset is None:
        return ()
    film = dataset.of_one_camera(range(len(dataset)))
    most = max(1, round(_LONGEST_SECONDS * frames_per_second))
    return chosen_frames(len(dataset), frames, film[:most])


def _write_web(
    format: Format,
    avatar: "Avatar",
    seen: "TrainingStatistics | None",
    dataset: "TrackedDataset | None",
    places: tuple[int, ...],
    performance: bool,
    destination: Path,
    options: "PageOptions",
) -> None:
    import torch

    from rgbavatar_ns.export import calm_theta, front_camera, write_web_module, write_web_page

    if dataset is None:
        camera, theta = front_camera(avatar, 512, 512), torch.zeros(1, avatar.layout.size)
    else:
        camera, theta = dataset.cameras.select([places[0]]), dataset.theta[list(places)]
    neutral = calm_theta(seen, theta[0])
    if dataset is None or not performance:
        theta = theta[:0]
    if format == "web":
        size = write_web_page(avatar, destination, camera, theta, options, seen, neutral)
        print(f"{destination}: {size / 1e6:.1f} MB; open it in a browser")
    else:
        rate = options.frames_per_second
        size = write_web_module(avatar, destination, camera, theta, rate, seen, neutral)
        print(f"{destination}: {size / 1e6:.1f} MB, the avatar; `python -m http.server` in there")
        print("shows example.html at http://localhost:8000/example.html")
