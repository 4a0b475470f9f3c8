import ctypes
import platform
import subprocess
import sys

from rgbavatar_ns.avatar.training.freed_memory import keep_freed_memory

_COUNTED = """
import resource
import torch
from rgbavatar_ns.avatar.training.freed_memory import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.empty(16 << 20).fill_(1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def usual():
    # What is allocated beside may once take a piece of the block that would be used again.
    return sorted(faults() for _ in range(9))[4]

fresh = usual()
print(keep_freed_memory(), fresh, usual())
"""


def test_memory_that_was_freed_is_used_again():
    # In a process of its own: the habit stays.
    told, fresh, kept = subprocess.run(
        [sys.executable, "-c", _COUNTED], check=True, capture_output=True, text=True
    ).stdout.split()
    if platform.libc_ver()[0] == "glibc":
        # 64 MiB come as pages of 4 KiB, or of 2 MiB where the system gives such.
        assert told == "True"
        assert int(fresh) >= 32
        assert int(kept) < 0.1 * int(fresh)
    else:
        assert told == "False"


def test_another_c_library_is_left_alone(monkeypatch):
    def no_library(name: object) -> object:
        raise OSError("no such library")

    for library in (no_library, lambda name: object()):
        monkeypatch.setattr(ctypes, "CDLL", library)
        assert keep_freed_memory() is False
