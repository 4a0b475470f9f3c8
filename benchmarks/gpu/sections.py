"""What is asked of a GPU, in which order, and how long each question may take."""

from dataclasses import dataclass

PREFLIGHT, SMOKE = "preflight", "smoke"


@dataclass(frozen=True)
class Section:
    """Questions that share a process.

    Attributes:
        place: the function that asks, as "module:function" beside this file.
        does: the questions, in a line.
        limit_s: seconds after which its process is left behind.
        explains: whether it finds the cause where the smoke test failed, and is then asked first.
        guest: whether it runs what is not ours, whose failure is none of ours.
    """

    name: str
    place: str
    does: str
    limit_s: float
    explains: bool = False
    guest: bool = False


SECTIONS = (
    Section(PREFLIGHT, "preflight:preflight", "what is there; a kernel without torch", 60),
    Section(SMOKE, "smoke:smoke", "compile, a picture, a training step, a replay", 60),
    Section("steps", "times:steps", "images/s of a whole step, memory", 45),
    Section("kernels", "kernel_times:kernels", "each kernel's time in a recorded step", 45),
    Section("waits", "waits:waits", "whether a step returns while the GPU sleeps", 30),
    Section("rendering", "times:rendering", "frames/s from theta to image", 45),
    Section("rasterizer", "times:rasterizer", "forward and backward, against the roofline", 45),
    Section("training", "training_times:whole_run", "50,000 images with all that is due", 60),
    Section("refinement", "training_times:refinement", "a step that corrects tracking", 30),
    Section("stream", "training_times:stream", "a step on frames from main memory", 30),
    Section("gsplat", "beside_gsplat:gsplat", "gsplat's kernels beside ours", 60, guest=True),
    Section("lists", "lists:lists", "lengths of tiles' lists, use of capacity", 30),
    Section("churn", "churn:churn", "replays while other memory comes and goes", 45, True),
    *(
        Section(tool, f"sanitizer:{tool}", f"compute-sanitizer's {tool}, small cases", 60, True)
        for tool in ("memcheck", "racecheck", "synccheck", "initcheck")
    ),
    Section("ncu", "counters:ncu", "how busy a step's kernels keep the GPU", 60),
)


def chosen_sections(names: str | None) -> tuple[Section, ...]:
    """Those named, separated by commas, in the order of the whole; all where None is given.

    Raises ValueError with the names that there are.
    """
    if names is None:
        return SECTIONS
    wanted = {name.strip() for name in names.split(",") if name.strip()}
    unknown = wanted - {section.name for section in SECTIONS}
    if unknown or not wanted:
        known = ", ".join(section.name for section in SECTIONS)
        raise ValueError(f"There is no section {', '.join(sorted(unknown)) or names!r}: {known}.")
    return tuple(section for section in SECTIONS if section.name in wanted)
