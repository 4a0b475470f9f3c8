"""Sweeps over presets, subjects and seeds, and the tables and plots made of them."""

from rgbavatar_ns.experiments.cells import Cell, cells_of
from rgbavatar_ns.experiments.spec import Experiment, read_experiment

__all__ = ["Cell", "Experiment", "cells_of", "read_experiment"]
