"""Folders of metrical-tracker's `.frame` files beside images, as four systems lay them out."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rgbavatar_ns.data.importers.folder import IMPORTED_SUFFIXES, Folder
from rgbavatar_ns.data.importers.frame_files import TrackedHeads, read_frame_files
from rgbavatar_ns.data.importers.frame_images import FrameImage
from rgbavatar_ns.data.importers.frame_record import FrameRecord
from rgbavatar_ns.data.importers.source import Reading, Source, assemble
from rgbavatar_ns.errors import UserError

CHECKPOINTS = "checkpoint"
_MATTES = ("alpha", "matted", "mask", "masks", "matte", "seg_mask", "image_mask")
_IMAGES = ("images", "input", "imgs", "image")
_Pictures = Mapping[int, Path]
"""By number."""


def is_metrical(folder: Folder) -> bool:
    """metrical-tracker's own output: `.frame` files and the pictures that it read."""
    return folder.has(CHECKPOINTS, "input") and not folder.has("images")


def is_gaussian_blendshapes(folder: Folder) -> bool:
    """GaussianBlendshapes: images with alpha, and the mesh of the subject at rest."""
    return folder.has(CHECKPOINTS, "images", "canonical.obj") and not _has_background(folder)


def is_nerf_blend_shape(folder: Folder) -> bool:
    """NeRFBlendShape: a picture of the background, masks beside the images."""
    return folder.has(CHECKPOINTS, "images") and _has_background(folder)


def is_rgbavatar(folder: Folder) -> bool:
    """RGBAvatar's own: `.frame` files and images, nothing else."""
    return folder.has(CHECKPOINTS, "images")


def _has_background(folder: Folder) -> bool:
    return folder.has("bc.jpg") or folder.has("image_mask")


def read_metrical(reading: Reading) -> Source:
    """metrical-tracker's output; it has no mattes of its own, so they are looked for."""
    options, folder = reading.options, reading.folder
    images = _pictures(folder, options.images, ("input", *_IMAGES))
    masks = _pictures(folder, options.masks, _MATTES)
    if images is None:
        raise UserError(
            f"{reading} has no folder of images ({', '.join(_IMAGES)}).",
            "Name it with --images, or the folder that holds the data.",
        )
    return _read(reading, images, masks)


def _pictures(folder: Folder, given: Path | None, usual: tuple[str, ...]) -> _Pictures | None:
    """The pictures of the folder given, or of the first usual one there is."""
    if given is not None:
        return folder.given(given).numbered(".", IMPORTED_SUFFIXES)
    there = next((name for name in usual if folder.has(name)), None)
    return None if there is None else folder.numbered(there, IMPORTED_SUFFIXES)


def read_gaussian_blendshapes(reading: Reading) -> Source:
    """GaussianBlendshapes: the last 350 frames are held out."""
    return _read(reading, _images(reading))


def read_nerf_blend_shape(reading: Reading) -> Source:
    """NeRFBlendShape: mattes in image_mask, the last 500 frames are held out."""
    masks = _pictures(reading.folder, None, ("image_mask",))
    return _read(reading, _images(reading), masks, last=500)


def read_rgbavatar(reading: Reading) -> Source:
    """RGBAvatar's own: frames and images belong together in the order of their names."""
    return _read(reading, _images(reading), by_order=True)


def _images(reading: Reading) -> _Pictures:
    return reading.folder.numbered("images", IMPORTED_SUFFIXES)


def _read(
    reading: Reading,
    images: _Pictures,
    masks: _Pictures | None = None,
    *,
    last: int = 350,
    by_order: bool = False,
) -> Source:
    """Images, mattes (or the images' own alpha), `.frame` files; all by number."""
    files = reading.folder.numbered(CHECKPOINTS, (".frame",))
    if by_order and len(files) == len(images) and list(files) != list(images):
        reading.report.note("frames and images have other numbers: paired in order")
        images = dict(zip(files, images.values()))
    tracked = read_frame_files(reading, files)
    records = pair(reading, tracked, images, masks)
    return assemble(reading, records, tracked.arrays, tracked.identity, last)


def pair(
    reading: Reading,
    tracked: TrackedHeads,
    images: Mapping[int, Path],
    masks: Mapping[int, Path] | None,
    regions: Mapping[int, tuple[Path, ...]] | None = None,
) -> list[FrameRecord]:
    """Records of the frames that have all their files; what lacks one goes into the report."""
    report = reading.report
    known = tracked.frames.keys() | tracked.unreadable
    report.leave_out("images without a record", [images[n].name for n in images if n not in known])
    report.leave_out(
        "records without an image", [f"frame {n}" for n in tracked.frames if n not in images]
    )
    records = []
    for number, head in tracked.frames.items():
        if number not in images:
            continue
        frame_image = FrameImage(images[number])
        if masks is not None:
            if number not in masks:
                report.leave_out("images without a matte", [images[number].name])
                continue
            frame_image = replace(frame_image, alpha=masks[number])
        if regions is not None:
            if number not in regions:
                report.leave_out("images without parsing masks", [images[number].name])
                continue
            frame_image = replace(frame_image, regions=regions[number])
        records.append(FrameRecord(number, frame_image, head.theta, head.camera, head.size))
    return records
