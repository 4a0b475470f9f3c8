"""Shared by all tests: few threads, so that the suite's time is steady on small machines."""

import os
import signal

import torch

os.environ.setdefault("MPLBACKEND", "Agg")
torch.set_num_threads(min(2, os.cpu_count() or 1))
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    # A shell that starts the suite in its background has it, and what it starts, ignore interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
