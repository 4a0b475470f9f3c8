"""Shared by all tests: few threads, so that the suite's time is steady on small machines."""

import copy
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from tests import checked_types

checked_types.install()
os.environ.setdefault("MPLBACKEND", "Agg")
torch.set_num_threads(min(2, os.cpu_count() or 1))
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    # A shell that starts the suite in its background has it, and what it starts, ignore interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What no package brings: a GPU or its absence, and films that are not in the repository.
_NOT_OF_PACKAGES = re.compile(r"there is a GPU|no clips? |the clip |the site is built by Python")


@pytest.fixture
def emulated(monkeypatch: pytest.MonkeyPatch):
    """The CUDA backend on the processor, in the place of the GPU's."""
    from tests.kernels.cuda import emulator  # here, for the types' checks to come before it

    if emulator.compiler() is None:
        pytest.skip("no g++ to emulate CUDA with")
    return emulator.install(monkeypatch)


@pytest.fixture(scope="session")
def flame_2020_pickle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic FLAME 2020 in a folder of its own, with what lies beside it; to be read only."""
    from rgbavatar_ns.synthetic.flame import write_synthetic_flame

    return write_synthetic_flame(tmp_path_factory.mktemp("flame_2020"))


@pytest.fixture(scope="session")
def flame_2020(flame_2020_pickle: Path):
    """Its arrays: reading them takes as long as writing them, seconds."""
    from rgbavatar_ns.head.flame import load_flame

    return load_flame(flame_2020_pickle)


@pytest.fixture(scope="session", autouse=True)
def outlines_are_measured_once() -> Iterator[None]:
    """Each training begins with it, an eighth of a second, and most tests' with the same frames."""
    from rgbavatar_ns.avatar.prior import outline
    from rgbavatar_ns.files import digest

    known: dict[str, outline.Outline] = {}
    measure = outline.measure_outline

    def measured(
        avatar: Any, field: Any, theta: torch.Tensor, cameras: Any, images_rgba: torch.Tensor
    ) -> outline.Outline:
        if theta.device.type != "cpu":  # there it is looked at where everything lies
            return measure(avatar, field, theta, cameras, images_rgba)
        seen_by = cameras.world_to_camera, cameras.focal_px, cameras.principal_point_px
        places = avatar.anchors.triangle_index, avatar.anchors.barycentric
        given = avatar.carrier_vertices(theta), *places, *seen_by, images_rgba
        arrays = [tensor.detach().numpy() for tensor in given]
        key = digest([avatar.head.arrays.digest(), *arrays])
        if key not in known:
            known[key] = measure(avatar, field, theta, cameras, images_rgba)
        return copy.deepcopy(known[key])

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(outline, "measure_outline", measured)
        yield


@pytest.fixture
def unchecked_types(monkeypatch: pytest.MonkeyPatch) -> None:
    """As users run it: without the tests' own checks of shapes and types, which speak first."""
    import jaxtyping

    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fail-on-missing",
        action="store_true",
        help="a test that is skipped for want of a package or a program fails",
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item):
    report = yield
    return report if item.get_closest_marker("cuda") else _failed_if_missing(report, item.config)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    return _failed_if_missing((yield), collector.config)


def _failed_if_missing(report, config: pytest.Config):
    if config.option.fail_on_missing and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[-1] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not _NOT_OF_PACKAGES.search(reason):
            report.outcome, report.longrepr = "failed", f"--fail-on-missing: {reason}"
    return report
