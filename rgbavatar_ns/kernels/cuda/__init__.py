"""The rasterizer on NVIDIA GPUs: kernels compiled at run time, nothing but a driver needed."""
