"""A procedural subject: a person made from the embedded head, filmed by ray casting."""

from rgbavatar_ns.synthetic.config import DemoConfig
from rgbavatar_ns.synthetic.make import DemoFilm, DemoPerson, film_demo, make_demo_dataset

__all__ = ["DemoConfig", "DemoFilm", "DemoPerson", "film_demo", "make_demo_dataset"]
