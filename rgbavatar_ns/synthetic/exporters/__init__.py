"""The demo subject as other systems' data, so that importers can be tried and tested."""

from rgbavatar_ns.synthetic.exporters.folders import NativeWriter
from rgbavatar_ns.synthetic.exporters.performer import DEMO_FORMATS, write_demo
from rgbavatar_ns.synthetic.exporters.take import FLAME_FOLDER, FlameFilm, Take, TakeFrame

__all__ = [
    "DEMO_FORMATS",
    "FLAME_FOLDER",
    "FlameFilm",
    "NativeWriter",
    "Take",
    "TakeFrame",
    "write_demo",
]
