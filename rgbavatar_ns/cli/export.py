"""`rgbavatar export`: the avatar for other programs and other people."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rgbavatar_ns.cli.progress import progress_bar
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.options import FrameRate

if TYPE_CHECKING:
    from rgbavatar_ns.avatar import Avatar
    from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
    from rgbavatar_ns.data import TrackedDataset

Format = Literal["bundle", "ply", "gltf", "spz", "compressed-ply", "sog", "texture", "web"]


def run(
    run_folder: Annotated[Path, tyro.conf.Positional],
    destination: Annotated[Path, tyro.conf.Positional],
    format: Format = "bundle",
    data: Path | None = None,
    frame: int | None = None,
    frames: tuple[int, int] | None = None,
    head_inside: bool = True,
    texture: Path | None = None,
    frames_per_second: FrameRate = 25.0,
    title: str = "Avatar",
) -> None:
    """Write an avatar as a bundle, as Gaussians for other programs, as a picture or as a web page.

    bundle: a folder that `Avatar.load` opens without nerfstudio, with what the avatar saw in
    training. ply, gltf, spz, compressed-ply, sog: the Gaussians of one frame, or a folder of
    several frames' (--frames), as viewers of 3D Gaussian splatting open them. texture: the head's
    colours as a picture to paint on, for --texture. web: one HTML file that plays and drives the
    avatar in a browser, without a server or a network.

    Args:
        run_folder: a run of ns-train, a checkpoint or an avatar bundle.
        destination: the file to write; for bundle, and with --frames, the folder.
        format: what to write.
        data: the dataset whose frames are meant; by default the one that the run names.
        frame: of Gaussians, the frame's place in the dataset; without it the head is at rest.
        frames: of Gaussians and for web, first frame and the frame after the last one.
        head_inside: for bundle, put the head model inside. Without it the bundle only names its
            head model, as the licence of FLAME asks where it is passed on.
        texture: a PNG painted over what --format texture wrote of this avatar: its colours change
            as it was changed.
        frames_per_second: for web, of the performance.
        title: for web, the page's title.
    """
    from rgbavatar_ns import Avatar
    from rgbavatar_ns.export import GAUSSIAN_FILES, read_texture, with_texture

    whole = Avatar.load(run_folder)
    if texture is not None:
        whole = with_texture(whole, read_texture(texture))
    avatar = whole.without_undrawn()
    if avatar.num_gaussians < whole.num_gaussians:
        left_out = whole.num_gaussians - avatar.num_gaussians
        print(f"{left_out} of {whole.num_gaussians} Gaussians show in no picture: left out.")
    dataset = _dataset(avatar, run_folder, data, needed=frame is not None or frames is not None)
    if format == "bundle":
        seen = _seen(avatar, run_folder, dataset)
        avatar.save(destination, statistics=seen, with_head=head_inside)
        print(f"Avatar.load({str(destination)!r}) opens it.")
    elif format in GAUSSIAN_FILES:
        _write_gaussians(avatar, dataset, format, frame, frames, destination)
    elif format == "texture":
        _write_texture(avatar, destination)
    else:
        seen = _seen(avatar, run_folder, dataset)
        _write_page(avatar, seen, dataset, frames, destination, frames_per_second, title)


def _seen(
    avatar: "Avatar", run_folder: Path, dataset: "TrackedDataset | None"
) -> "TrainingStatistics | None":
    """What the avatar saw in training, if that is known."""
    from rgbavatar_ns.avatar.storage.bundle import load_statistics
    from rgbavatar_ns.export import statistics_of

    return load_statistics(run_folder) if dataset is None else statistics_of(avatar, dataset)


def _dataset(
    avatar: "Avatar", run_folder: Path, data: Path | None, *, needed: bool
) -> "TrackedDataset | None":
    """The named dataset, or the run's own; None where there is none and none is needed."""
    from rgbavatar_ns.data import load_dataset
    from rgbavatar_ns.export import dataset_folder

    folder = dataset_folder(run_folder) if data is None else data
    if data is None and folder == run_folder:
        if needed:
            raise UserError("Frames are those of a dataset.", "Name it with --data.")
        return None
    try:
        dataset = load_dataset(folder)
    except UserError as error:
        if data is not None or needed:
            raise
        print(f"note: {error.cause} It goes without the frames of the run's own data.")
        return None
    avatar.require_layout(dataset.layout, f"The dataset {folder}")
    return dataset


def _write_gaussians(
    avatar: "Avatar",
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


def _write_page(
    avatar: "Avatar",
    seen: "TrainingStatistics | None",
    dataset: "TrackedDataset | None",
    frames: tuple[int, int] | None,
    destination: Path,
    frames_per_second: float,
    title: str,
) -> None:
    import torch

    from rgbavatar_ns.export import PageOptions, front_camera, write_web_page
    from rgbavatar_ns.export.scenes import chosen_frames

    if dataset is None:
        camera, theta = front_camera(avatar, 512, 512), torch.zeros(0, avatar.layout.size)
    else:
        chosen = chosen_frames(len(dataset), frames, range(len(dataset)))
        camera, theta = dataset.cameras.select([chosen[0]]), dataset.theta[list(chosen)]
    options = PageOptions(title, frames_per_second)
    size = write_web_page(avatar, destination, camera, theta, options, seen)
    print(f"{destination}: {size / 1e6:.1f} MB; open it in a browser")
