"""What the compiled CUDA kernels hold, without a GPU: registers, instructions by kind, occupancy.

    python benchmarks/speed/compiled.py [--arch sm_90] [--against REV] [--loops KERNEL ...]

Prints a markdown table by kernel; with `--against`, "before → after" of the sources of a revision
and those of this checkout. Counts are of the code, in which a loop stands once: `--loops` counts
the bodies of a kernel's innermost loops, which is where the time goes. Needs a checkout and the
`dev` extra, whose nvidia-cuda-nvdisasm takes NVRTC's machine code apart.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from rgbavatar_ns.kernels import DeviceError
from rgbavatar_ns.kernels.cuda.compiler import compile_sources
from rgbavatar_ns.kernels.cuda.source import FOLDERS, sources

ROOT = Path(__file__).resolve().parents[2]

_KINDS = {
    "FP32": r"FADD|FMUL|FFMA|FMNMX|FSEL|FSET|FSETP|FCHK",
    "MUFU": "MUFU",
    "calls": "CALL",
    "shuffles": "SHFL",
    "votes": "VOTE|VOTEU",
    "atomics": "ATOM|ATOMG|ATOMS|RED|REDG",
    "branches": "BRA|BRX|JMP|EXIT|RET",
    "barriers": "BAR",
    "local": "LDL|STL",
}
_MEMORY = {
    "shared loads": "LDS",
    "shared stores": "STS",
    "global loads": "LDG",
    "global stores": "STG",
}
_SECTION = re.compile(r"^\t\.section\t\.text\.(\w+)_kernel,", re.MULTILINE)
_LINE = re.compile(r"^(?:(\.L_x_\w+):|\s+/\*([0-9a-f]{4,})\*/\s+(?:@!?U?P\w+ )?([A-Z][\w.]*)(.*))")
_WIDTHS = {"U8": 1, "S8": 1, "U16": 2, "S16": 2, "64": 8, "128": 16, "256": 32}
_REPORT = re.compile(
    r"entry function '(\w+)_kernel'.*?(\d+) bytes spill stores, (\d+) bytes spill loads.*?"
    r"Used (\d+) registers[^\n]*",
    re.DOTALL,
)
_THREADS = re.compile(r"^RGBAVATAR_KERNEL\((\w+), \w+, (\w+)(?:, \w+)?\)", re.MULTILINE)
# Of an SM: threads, blocks, bytes of shared memory, and those that each block loses of it (CUDA
# programming guide, "Compute capabilities"). All have 65,536 registers, given to warps by 256.
_SM = {
    "sm_75": (1024, 16, 64 << 10, 0),
    "sm_80": (2048, 32, 164 << 10, 1024),
    "sm_86": (1536, 16, 100 << 10, 1024),
    "sm_89": (1536, 24, 100 << 10, 1024),
    "sm_90": (2048, 32, 228 << 10, 1024),
    "sm_120": (1536, 24, 100 << 10, 1024),
}


@dataclass(frozen=True)
class Instruction:
    """One line of SASS: where it stands, its name with modifiers, and where it may branch to."""

    address: int
    name: str
    target: int | None = None

    @property
    def kind(self) -> str:
        """The name without modifiers."""
        return self.name.split(".")[0]

    @property
    def width(self) -> int:
        """Bytes that a thread moves by it."""
        parts = self.name.split(".")[1:]
        return next((_WIDTHS[part] for part in parts if part in _WIDTHS), 4)


@dataclass(frozen=True)
class Kernel:
    """What a kernel was compiled to."""

    registers: int
    spilled_bytes: int
    shared_bytes: int
    threads: int
    instructions: tuple[Instruction, ...]

    def figures(self, architecture: str) -> dict[str, str]:
        """The columns of the table."""
        return {
            "registers": str(self.registers),
            "spills, B": str(self.spilled_bytes),
            "shared, B": str(self.shared_bytes),
            "blocks/SM": str(blocks_per_sm(self, architecture)),
            **count(self.instructions),
        }

    def innermost_loops(self) -> list[tuple[Instruction, ...]]:
        """The bodies of loops that hold no other one, in the order of the code."""
        jumps = [(i.target, i.address) for i in self.instructions if i.target is not None]
        spans = {(low, high) for low, high in jumps if low <= high}
        inner = [
            (low, high)
            for low, high in spans
            if not any(low <= a and b <= high and (a, b) != (low, high) for a, b in spans)
        ]
        return [
            tuple(i for i in self.instructions if low <= i.address <= high)
            for low, high in sorted(inner)
            if low < high  # the trap behind a kernel's end jumps to itself
        ]


def count(instructions: Sequence[Instruction]) -> dict[str, str]:
    """Instructions in all and by kind; accesses with the bytes that each moves."""
    kinds = Counter(i.kind for i in instructions if i.kind != "NOP")
    out = {"instructions": str(kinds.total())}
    for name, pattern in _KINDS.items():
        out[name] = str(sum(n for kind, n in kinds.items() if re.fullmatch(pattern, kind)))
    for name, kind in _MEMORY.items():
        widths = Counter(i.width for i in instructions if i.kind == kind)
        out[name] = ", ".join(f"{n} x {w} B" for w, n in sorted(widths.items())) or "0"
    return out


def blocks_per_sm(kernel: Kernel, architecture: str) -> int:
    """Blocks that an SM holds at once, by registers, threads and static shared memory."""
    threads, blocks, shared, lost = _SM[architecture]
    warps = kernel.threads // 32
    by_registers = (65536 // (-(-kernel.registers * 32 // 256) * 256)) // warps
    taken = kernel.shared_bytes + lost
    return min(
        blocks, threads // kernel.threads, by_registers, shared // taken if taken else blocks
    )


def disassembled(code: bytes) -> dict[str, tuple[Instruction, ...]]:
    """The instructions of every kernel of a cubin."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(code)
        file.flush()
        ran = subprocess.run(
            [str(_nvdisasm()), "-c", file.name], capture_output=True, text=True, check=True
        )
    return parse_sass(ran.stdout)


def parse_sass(text: str) -> dict[str, tuple[Instruction, ...]]:
    """The instructions of every kernel in nvdisasm's text."""
    parts = _SECTION.split(text)[1:]
    return {name: tuple(_instructions(body)) for name, body in zip(parts[::2], parts[1::2])}


def _instructions(body: str) -> list[Instruction]:
    labels, lines, waiting = {}, [], []
    for match in filter(None, map(_LINE.match, body.splitlines())):
        label, address, name, rest = match.groups()
        if label:
            waiting.append(label)
            continue
        labels.update(dict.fromkeys(waiting, int(address, 16)))
        waiting.clear()
        target = re.search(r"`\((\.L_x_\w+)\)", rest) if name.startswith("BRA") else None
        lines.append((int(address, 16), name, target[1] if target else ""))
    return [Instruction(address, name, labels.get(to)) for address, name, to in lines]


def _nvdisasm() -> Path:
    try:
        files = metadata.files("nvidia-cuda-nvdisasm") or []
        return next(Path(str(f.locate())) for f in files if f.stem == "nvdisasm")
    except (metadata.PackageNotFoundError, StopIteration):
        raise DeviceError(
            "There is no nvdisasm to take machine code apart.",
            "pip install --no-deps nvidia-cuda-nvdisasm",
        ) from None


def compiled(texts: Mapping[str, str], architecture: str) -> dict[str, Kernel]:
    """Every kernel of the sources, compiled for an architecture."""
    code, log = compile_sources(texts, architecture)
    reports = {m[1]: (m[0], *map(int, m.groups()[1:])) for m in _REPORT.finditer(log)}
    joined = "\n".join(texts.values())
    threads = dict(_THREADS.findall(joined))
    out = {}
    for name, instructions in disassembled(code).items():
        text, stored, loaded, registers = reports[name]
        shared = re.search(r"(\d+) bytes smem", text)
        size = re.search(rf"\b{threads[name]} = (\d+)", joined)
        assert size is not None, threads[name]
        shared_bytes = int(shared[1]) if shared else 0
        out[name] = Kernel(registers, stored + loaded, shared_bytes, int(size[1]), instructions)
    return dict(sorted(out.items()))


def sources_of(revision: str) -> dict[str, str]:
    """The kernels' sources as they were in a revision of this repository."""
    out = {}
    for folder in FOLDERS:
        path = folder.relative_to(ROOT).as_posix()
        for file in _git("ls-tree", "--name-only", revision, f"{path}/").split():
            out[Path(file).name] = _git("show", f"{revision}:{file}")
    return out


def _git(*arguments: str) -> str:
    ran = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True)
    if ran.returncode:
        raise DeviceError(
            f"git {' '.join(arguments[:2])} failed: {ran.stderr.strip()}",
            "Name a commit of this checkout, such as HEAD~1.",
        )
    return ran.stdout


def markdown(rows: Mapping[str, Mapping[str, str]]) -> str:
    """A table; columns that say nothing but 0 are left out."""
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    names = [name for name in names if any(row.get(name, "0") != "0" for row in rows.values())]
    lines = [["kernel", *names], ["---"] * (1 + len(names))]
    lines += [[kernel, *(row.get(name, "-") for name in names)] for kernel, row in rows.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def beside(before: Mapping[str, str] | None, after: Mapping[str, str] | None) -> dict[str, str]:
    """One value where nothing changed, else "before → after"; "-" where there is no such kernel."""
    was, now = before or {}, after or {}
    pairs = {name: (was.get(name, "-"), now.get(name, "-")) for name in {**was, **now}}
    return {name: a if a == b else f"{a} → {b}" for name, (a, b) in pairs.items()}


def rows_of(
    kernels: Mapping[str, Kernel], architecture: str, loops: Sequence[str]
) -> dict[str, dict[str, str]]:
    """The table's rows: kernels, or the innermost loops of some."""
    if not loops:
        return {name: kernel.figures(architecture) for name, kernel in kernels.items()}
    return {
        f"{name}, loop {place}": count(body)
        for name in loops
        for place, body in enumerate(kernels[name].innermost_loops(), 1)
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--arch", default="sm_90", choices=sorted(_SM))
    parser.add_argument("--against", metavar="REV", help="a revision to compare with")
    parser.add_argument("--loops", metavar="KERNEL", nargs="+", default=[])
    options = parser.parse_args(arguments)
    try:
        kernels = compiled(sources(), options.arch)
        if unknown := sorted(set(options.loops) - set(kernels)):
            raise DeviceError(f"There is no kernel {unknown[0]}.", f"Of: {', '.join(kernels)}.")
        rows = rows_of(kernels, options.arch, options.loops)
        if options.against:
            earlier = compiled(sources_of(options.against), options.arch)
            known = [name for name in options.loops if name in earlier]
            before = rows_of(earlier, options.arch, known) if known or not options.loops else {}
            names = sorted({**before, **rows})
            rows = {name: beside(before.get(name), rows.get(name)) for name in names}
    except DeviceError as error:
        print(error, file=sys.stderr)
        return 1
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
