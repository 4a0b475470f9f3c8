"""Shared by all tests: few threads, so that the suite's time is steady on small machines."""

import os

import torch

os.environ.setdefault("MPLBACKEND", "Agg")
torch.set_num_threads(min(2, os.cpu_count() or 1))
