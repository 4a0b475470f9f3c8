"""Other systems' datasets: recognised, checked, and turned into the project's own format."""

from rgbavatar_ns.data.importers.cached import open_foreign
from rgbavatar_ns.data.importers.convert import import_dataset
from rgbavatar_ns.data.importers.formats import FORMATS, Format, find_format, read_source
from rgbavatar_ns.data.importers.options import ImportOptions
from rgbavatar_ns.data.importers.source import Source

__all__ = [
    "FORMATS",
    "Format",
    "ImportOptions",
    "Source",
    "find_format",
    "import_dataset",
    "open_foreign",
    "read_source",
]
