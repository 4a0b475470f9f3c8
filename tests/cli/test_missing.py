"""`rgbavatar info`: what is missing is found, and told with a line that brings it."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from rgbavatar_ns.cli import missing
from rgbavatar_ns.cli.main import main

ROOT = Path(__file__).parents[2]


def having(**versions: str) -> Callable[[str], str | None]:
    named = {name.replace("_", "-"): version for name, version in versions.items()}
    return named.get


def test_one_opencv_with_contrib_is_what_is_wanted() -> None:
    assert list(missing.opencv(having(opencv_contrib_python_headless="4.10.0.84"))) == []


@pytest.mark.parametrize(
    "builds",
    [
        {},
        {"opencv_python_headless": "4.10.0.84"},
        {"opencv_python": "4.11.0.86", "opencv_contrib_python_headless": "4.10.0.84"},
    ],
)
def test_every_other_opencv_goes_away_and_the_wanted_one_comes(builds: dict[str, str]) -> None:
    (told,) = missing.opencv(having(**builds))
    away, _, comes = told.remedy.rpartition("pip install --no-deps ")
    assert set(away.replace("&&", "").split()[3:]) == {name.replace("_", "-") for name in builds}
    assert all(name.replace("_", "-") in told.cause for name in builds)
    assert comes in {line.strip().partition(" ;")[0] for line in _lines("install.txt")}


def test_the_protobuf_of_nerfstudio_is_told_with_the_one_that_the_list_has() -> None:
    (told,) = missing.tracker(having(mediapipe="0.10.21", protobuf="3.20.3"))
    assert "3.20.3" in told.cause
    pinned = {line.partition(" ;")[0] for line in _lines("install.txt")}
    assert {"mediapipe==0.10.21", "protobuf==4.25.9"} <= pinned & set(told.remedy.split())
    assert list(missing.tracker(having(mediapipe="0.10.21", protobuf="4.25.9"))) == []
    assert [told.cause for told in missing.tracker(having())] == ["no mediapipe"]


def test_a_driver_beside_a_torch_for_cpus_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    driver: Callable[[str], str | None] = {"nvidia-smi": "/usr/bin/nvidia-smi"}.get
    monkeypatch.setattr(torch.version, "cuda", None)
    assert "CPUs" in next(missing.gpu_build(having(), driver)).cause
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    assert '"cuda-bindings==13.*"' in next(missing.gpu_build(having(), driver)).remedy
    complete = having(cuda_bindings="13.0.1")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)  # a driver that is older
    assert "13.0 sees no GPU" in next(missing.gpu_build(complete, driver)).cause
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert list(missing.gpu_build(complete, driver)) == []
    assert list(missing.gpu_build(having(), lambda _: None)) == []


def test_info_ends_with_what_is_missing_and_its_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = missing.Missing("dancing", "no shoes", "pip install shoes")
    monkeypatch.setattr(missing, "all_missing", lambda: iter([gone]))
    main(["info"])
    assert "dancing: no shoes\n    pip install shoes" in capsys.readouterr().out
    monkeypatch.setattr(missing, "all_missing", lambda: iter([]))
    main(["info"])
    assert capsys.readouterr().out.endswith("nothing is missing\n")


def test_where_nothing_is_installed_each_thing_is_told_once_with_a_line() -> None:
    found = list(missing.all_missing(having(), lambda _: None))
    assert len({item.task + item.cause for item in found}) == len(found) > 6
    assert all("install" in item.remedy for item in found)


def _lines(name: str) -> list[str]:
    text = (ROOT / "requirements" / name).read_text()
    return [line for line in text.splitlines() if line and not line.startswith("#")]
