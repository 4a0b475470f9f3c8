"""A device that is not the processor's, where there is no GPU: see elsewhere.cpp."""

import types
from pathlib import Path

import torch
from torch.utils import cpp_extension

NAME = "elsewhere"
_SOURCE = Path(__file__).with_name("elsewhere.cpp")


def begin(build_folder: Path) -> None:
    """Compile the device, some twenty seconds, and have torch know it by its name."""
    cpp_extension.load(
        "elsewhere_device", [str(_SOURCE)], ["-O0"], build_directory=str(build_folder)
    )
    torch.utils.rename_privateuse1_backend(NAME)
    module = types.ModuleType(f"torch.{NAME}")
    module.__dict__.update(
        is_available=lambda: True,
        is_initialized=lambda: True,
        device_count=lambda: 1,
        current_device=lambda: 0,
        _is_in_bad_fork=lambda: False,
        manual_seed_all=lambda seed: None,
    )
    torch._register_device_module(NAME, module)
    torch.utils.generate_methods_for_privateuse1_backend()
