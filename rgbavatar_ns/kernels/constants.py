"""The numbers of the blending rule and of its targets.

`shared/gaussian_math.h` repeats them for compiled backends; a test compares the two lists.
"""

NEAR_PLANE_M = 0.01
"""Gaussians whose centre lies nearer to the camera plane than this are not drawn."""

DILATION_PX2 = 0.3
"""Added to both variances of every projected Gaussian: the usual low-pass filter of 3DGS."""

MAX_ALPHA = 0.999
"""Alphas above are cut to it, without gradient."""

MIN_ALPHA = 1 / 255
"""Contributions below are dropped."""

MIN_TRANSMITTANCE = 1e-4
"""A block of pixels ends when the transmittance of every pixel in it is below."""

BLOCK_PX = 4
"""Side of the pixel blocks that end together."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian is taken no further outside the image than this share of half its size."""

MIN_QUAT_NORM = 1e-12
"""Gaussians with a shorter quaternion have no orientation and are not drawn."""

MAX_AVERAGE_CHANNELS = 8
"""Most channels `weighted_color_average` takes."""

UNFILMED_RGBA = (254, 1, 253, 0)
"""In an 8-bit image with straight alpha: nobody filmed this pixel, and it counts for nothing.

Where alpha is 0 colour means nothing, so one is free to say this. Nearly magenta, for who drops
alpha, but not magenta itself, by which pictures are keyed.
"""
