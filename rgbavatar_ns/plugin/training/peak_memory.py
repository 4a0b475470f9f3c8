"""How much memory a run has taken at most."""

import resource
import sys

import torch

_MIB = 1 << 20


def peak_memory(device: torch.device | str) -> dict[str, float]:
    """`peak_mib` of this process in main memory, and `gpu_peak_mib` of its tensors on a GPU.

    Since the process began: a resumed run counts from there.
    """
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    peak = {"peak_mib": most / (_MIB if sys.platform == "darwin" else 1024)}
    if torch.device(device).type == "cuda":
        peak["gpu_peak_mib"] = torch.cuda.max_memory_allocated(device) / _MIB
    return peak
