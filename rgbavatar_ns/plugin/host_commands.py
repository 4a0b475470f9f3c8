"""What nerfstudio's own commands cannot do with this method, in the words of a user's error."""

from types import TracebackType

from rgbavatar_ns.errors import UserError

_EXPORTER, _RENDER = "nerfstudio.scripts.exporter", "nerfstudio.scripts.render"


def told_of_command(error: BaseException, trace: TracebackType | None) -> UserError | None:
    """The user's error in place of what ends `ns-export` or `ns-render`; None for all else.

    nerfstudio's commands assert the methods that they know, and offer a method no other place to
    answer in.
    """
    while trace is not None:
        frame = trace.tb_frame
        module, command = frame.f_globals.get("__name__"), frame.f_locals.get("self")
        ours = type(frame.f_locals.get("pipeline")).__module__.startswith("rgbavatar_ns.")
        if module == _EXPORTER and ours and isinstance(error, AssertionError):
            return UserError(
                "ns-export writes the fields of other methods; of this one it writes the cameras.",
                "Use `rgbavatar export RUN DST --format ply` (or spz, sog, gltf, web, bundle).",
            )
        if module == _RENDER and ours:
            told = _of_rendering(error, command)
            if told is not None:
                return told
        trace = trace.tb_next
    return None


def _of_rendering(error: BaseException, command: object) -> UserError | None:
    kind = type(command).__name__
    if kind == "SpiralRender" and isinstance(error, AssertionError):
        return UserError(
            "ns-render spiral moves a camera before a scene that stands still, and upside down "
            "before a face.",
            "Use `rgbavatar render RUN OUT --show orbit`, or turntable.",
        )
    steps = getattr(command, "interpolation_steps", 1)
    if kind == "RenderInterpolated" and isinstance(error, ValueError) and steps < 1:
        return UserError(f"--interpolation-steps is {steps}.", "Give 1 or more.")
    return None
