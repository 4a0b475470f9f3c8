"""What nerfstudio's own commands cannot do with this method, in the words of a user's error."""

from pathlib import Path
from types import TracebackType

from rgbavatar_ns.errors import UserError

_EVAL = "nerfstudio.scripts.eval"
_EXPORTER, _RENDER = "nerfstudio.scripts.exporter", "nerfstudio.scripts.render"
_WRITER = "nerfstudio.utils.writer"
_SERVICES = {
    "WandbWriter": "Run `wandb login`, or set WANDB_MODE=offline to log without network",
    "CometWriter": "Set COMET_API_KEY",
}


def told_of_command(error: BaseException, trace: TracebackType | None) -> UserError | None:
    """The user's error in place of what ends one of nerfstudio's commands; None for all else.

    These assert the methods that they know, and offer a method no other place to answer in. And
    services that keep logs may be absent, or want an account.
    """
    if isinstance(error, UserError):
        return None
    while trace is not None:
        frame = trace.tb_frame
        module, command = frame.f_globals.get("__name__"), frame.f_locals.get("self")
        ours = type(frame.f_locals.get("pipeline")).__module__.startswith("rgbavatar_ns.")
        if module == _EXPORTER and ours and isinstance(error, AssertionError):
            return UserError(
                "This kind of ns-export takes other methods; of this one `cameras` are written.",
                "`rgbavatar export RUN DST --format ply` writes Gaussians of one frame or of many; "
                "gltf, spz, sog, web and others: `rgbavatar export --help`. There is no mesh.",
            )
        if module == _EVAL and ours and isinstance(error, AssertionError):
            told = _of_scores(command)
            if told is not None:
                return told
        if module == _RENDER and ours:
            told = _of_rendering(error, command)
            if told is not None:
                return told
        service = _SERVICES.get(type(command).__name__)
        if module == _WRITER and service and frame.f_code.co_name == "__init__":
            first_line = (str(error).splitlines() or [type(error).__name__])[0]
            cause = f"The service that --vis names does not start: {first_line}"
            return UserError(cause, f"{service}; or take --vis viewer+tensorboard.")
        trace = trace.tb_next
    return None


def _of_scores(command: object) -> UserError | None:
    path = getattr(command, "output_path", None)
    if not isinstance(path, Path) or path.suffix == ".json":
        return None
    given = f"--output-path is {path}, but scores are written as JSON."
    return UserError(given, "Name a file that ends in .json.")


def _of_rendering(error: BaseException, command: object) -> UserError | None:
    kind = type(command).__name__
    if kind == "SpiralRender" and isinstance(error, AssertionError):
        return UserError(
            "ns-render spiral moves a camera before a scene that stands still, and upside down "
            "before a face.",
            "`rgbavatar render RUN OUT --show turntable` turns the camera about the head, --show "
            "orbit swings it around; `ns-render interpolate`, `camera-path` and `dataset` work.",
        )
    steps = getattr(command, "interpolation_steps", 1)
    if kind == "RenderInterpolated" and isinstance(error, ValueError) and steps < 1:
        return UserError(f"--interpolation-steps is {steps}.", "Give 1 or more.")
    return None
