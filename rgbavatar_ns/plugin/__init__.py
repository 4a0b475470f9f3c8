"""What nerfstudio sees of the project; importing it leaves out two warnings, and a slow search.

Both warnings are told on every start, and nobody who trains can act on them: nerfstudio 1.1.5
calls torch's autocasting by its earlier names, and torchvision's decoder of pictures, which is not
used here, may be of another build than torch. They come last, so that `python -W` decides where it
is given.
"""

import inspect
import sys
import warnings

warnings.filterwarnings(
    "ignore", r"`torch\.cuda\.amp\.", FutureWarning, r"nerfstudio\.", append=True
)
warnings.filterwarnings(
    "ignore", "Failed to load image Python extension", UserWarning, r"torchvision\.", append=True
)


def _tell_inspect_of_importing() -> None:
    """Tell `inspect` which modules the frames of the import under way are of.

    nerfstudio 1.1.5 looks at the stack once for each method that it could install, and `inspect`
    goes through all that is loaded whenever a frame's file is of none: a fifth of every start.
    """
    frame = sys._getframe()
    while frame is not None:
        name, file = frame.f_globals.get("__name__"), frame.f_code.co_filename
        if file.startswith("<frozen ") and name in sys.modules:
            inspect.modulesbyfile.setdefault(file, name)
        frame = frame.f_back


_tell_inspect_of_importing()
