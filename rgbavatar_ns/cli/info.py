"""`rgbavatar info`: the machine and the software, for a bug report or a first look."""

import importlib.metadata
import os
import platform


def run() -> None:
    """Print versions, devices, the rasterizer backends, and what is missing with what brings it."""
    import torch

    import rgbavatar_ns
    from rgbavatar_ns.cli.missing import all_missing
    from rgbavatar_ns.kernels import available_backends, unavailable_backends

    cuda = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none"
    rows = {
        "rgbavatar_ns": rgbavatar_ns.__version__,
        "python": f"{platform.python_version()}, {platform.system()} {platform.machine()}",
        "torch": torch.__version__,
        "nerfstudio": importlib.metadata.version("nerfstudio"),
        "cpu": f"{os.cpu_count()} cores, {torch.get_num_threads()} threads used",
        "cuda": cuda,
        "rasterizer backends": ", ".join(available_backends()),
        **{f"  without {name}": reason for name, reason in unavailable_backends().items()},
    }
    width = max(map(len, rows))
    for name, value in rows.items():
        print(f"{name:<{width}}  {value}")
    missing = list(all_missing())
    print("\nnothing is missing" if not missing else "\nmissing, and what brings it:")
    for item in missing:
        print(f"  {item.task}: {item.cause}\n    {item.remedy}")
