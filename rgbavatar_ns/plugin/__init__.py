"""What nerfstudio sees of the project; whatever imports it leaves out two warnings of libraries.

Both are told on every start, and nobody who trains can act on them: nerfstudio 1.1.5 calls torch's
autocasting by its earlier names, and torchvision's decoder of pictures, which is not used here,
may be of another build than torch. They come last, so that `python -W` decides where it is given.
"""

import warnings

warnings.filterwarnings(
    "ignore", r"`torch\.cuda\.amp\.", FutureWarning, r"nerfstudio\.", append=True
)
warnings.filterwarnings(
    "ignore", "Failed to load image Python extension", UserWarning, r"torchvision\.", append=True
)
