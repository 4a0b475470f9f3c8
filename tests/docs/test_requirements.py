"""The lists of requirements/, and everywhere that a version of ours stands."""

import re
import sys
from pathlib import Path

import pytest
import yaml
from packaging.markers import Marker, default_environment
from packaging.requirements import Requirement

import rgbavatar_ns

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
PLATFORMS = [
    {"python_version": version, "python_full_version": f"{version}.5", **system}
    for version in ("3.10", "3.11", "3.12")
    for system in (
        {"sys_platform": "linux", "platform_machine": "x86_64", "os_name": "posix"},
        {"sys_platform": "linux", "platform_machine": "aarch64", "os_name": "posix"},
        {"sys_platform": "darwin", "platform_machine": "arm64", "os_name": "posix"},
        {"sys_platform": "win32", "platform_machine": "AMD64", "os_name": "nt"},
    )
]


def requirements(name: str) -> list[Requirement]:
    text = (ROOT / "requirements" / name).read_text()
    return [Requirement(line) for line in text.splitlines() if line and line[0] != "#"]


def holds(marker: Marker | None, platform: dict[str, str]) -> bool:
    return marker is None or marker.evaluate({**default_environment(), **platform})


def pinned(name: str, platform: dict[str, str]) -> dict[str, str]:
    found = [one for one in requirements(name) if holds(one.marker, platform)]
    names = [one.name for one in found]
    assert len(set(names)) == len(names), "one version of each"
    return {one.name: str(one.specifier).removeprefix("==") for one in found}


@pytest.mark.parametrize("platform", PLATFORMS, ids=lambda platform: "-".join(platform.values()))
def test_pips_list_has_what_a_run_needs_at_the_tested_versions(platform: dict[str, str]) -> None:
    listed, tested = pinned("install.txt", platform), pinned("constraints.txt", platform)
    assert listed.items() <= tested.items()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for line in project["dependencies"] + project["optional-dependencies"]["track"]:
        wanted = Requirement(line)
        if wanted.name == "torch" or not holds(wanted.marker, platform):
            continue
        assert wanted.specifier.contains(listed[wanted.name]), line
    assert [name for name in listed if name.startswith("opencv")] == [
        "opencv-contrib-python-headless"
    ]
    assert not {"torch", "torchvision", "open3d"} & set(listed)
    assert not [name for name in listed if name.startswith("nvidia")]


def test_one_version_everywhere() -> None:
    version = rgbavatar_ns.__version__
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == version
    newest = re.search(r"^## (\d\S+)", (ROOT / "CHANGELOG.md").read_text(), flags=re.M)
    assert newest is not None
    assert newest[1] == version


@pytest.mark.parametrize("path", sorted(ROOT.glob(".github/**/*.yml")), ids=lambda path: path.stem)
def test_files_for_the_hosting_site_are_read_and_actions_have_versions(path: Path) -> None:
    content = yaml.safe_load(path.read_text())
    assert isinstance(content, dict)
    for action in re.findall(r"uses: *(\S+)", path.read_text()):
        assert re.fullmatch(r"actions/[\w-]+@v\d+", action), action


def test_the_workflows_run_commands_that_are_there() -> None:
    text = "".join(path.read_text() for path in sorted(ROOT.glob(".github/workflows/*.yml")))
    targets = re.findall(r"\bmake (\w[\w-]*)", text)
    assert "test" in targets
    assert set(targets) <= set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    scripts = re.findall(r"scripts/\w+\.py", text)
    assert scripts
    assert all((ROOT / script).is_file() for script in scripts)


def test_the_lines_of_install_md_take_the_torch_that_setup_takes() -> None:
    page = (ROOT / "docs/install.md").read_text()
    setup = (ROOT / "scripts/setup_env.py").read_text()
    torch = re.search(r'^TORCH = "(.*)"', setup, flags=re.M)
    assert torch is not None
    assert f"torch=={torch[1]}" in (ROOT / "requirements/constraints.txt").read_text().split()
    lines = re.findall(r"^pip install .* torch torchvision==(\S+) && .*$", page, flags=re.M)
    assert len(lines) == 2
    assert len(re.findall(r"^uv pip install .* torch torchvision==", page, flags=re.M)) == 2
    lines = re.findall(r"torchvision==(\S+)", page)
    assert all(f"torchvision=={version}" in setup for version in lines)
    for path in re.findall(r"(?:-r|-c|--override) (requirements/\S+)", page):
        assert (ROOT / path).is_file()
