"""The rasterizer in C++ for processors."""

INSTRUCTION_SET_VARIABLE = "RGBAVATAR_INSTRUCTION_SET"
"""Environment variable that forces one copy of the compiled loops: generic, avx2 or avx512."""
