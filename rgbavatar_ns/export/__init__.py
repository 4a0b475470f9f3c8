"""Taking the avatar away: pictures and films of it, its Gaussians and colours, a web page."""

from rgbavatar_ns.export.bases import basis_grid
from rgbavatar_ns.export.comparison import comparison_frames, write_comparison
from rgbavatar_ns.export.drawing import draw, pictures
from rgbavatar_ns.export.filmed import as_filmed, is_of, within_film
from rgbavatar_ns.export.gaussian_files import (
    GAUSSIAN_FILES,
    write_gaussian_sequence,
    write_gaussians,
)
from rgbavatar_ns.export.gltf import write_gltf
from rgbavatar_ns.export.own_film import as_trained_on
from rgbavatar_ns.export.ply import write_ply
from rgbavatar_ns.export.run_data import dataset_folder, statistics_of
from rgbavatar_ns.export.texture import color_texture, read_texture, with_texture, write_texture
from rgbavatar_ns.export.video import FilmWriter, write_gif, write_png, write_pngs, write_video
from rgbavatar_ns.export.views import (
    front_camera,
    read_camera_path,
    resized,
    swing,
)
from rgbavatar_ns.export.web_manifest import calm_theta
from rgbavatar_ns.export.web_module import write_web_module
from rgbavatar_ns.export.web_page import PageOptions, write_web_page

__all__ = [
    "GAUSSIAN_FILES",
    "FilmWriter",
    "PageOptions",
    "as_filmed",
    "as_trained_on",
    "basis_grid",
    "calm_theta",
    "color_texture",
    "comparison_frames",
    "dataset_folder",
    "draw",
    "front_camera",
    "is_of",
    "pictures",
    "read_camera_path",
    "read_texture",
    "resized",
    "statistics_of",
    "swing",
    "with_texture",
    "within_film",
    "write_comparison",
    "write_gaussian_sequence",
    "write_gaussians",
    "write_gif",
    "write_gltf",
    "write_ply",
    "write_png",
    "write_pngs",
    "write_texture",
    "write_video",
    "write_web_module",
    "write_web_page",
]
