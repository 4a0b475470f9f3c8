"""How nerfstudio's commands start with this plugin: what they load, print and show first."""

import subprocess
import sys
from dataclasses import dataclass, fields
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from rgbavatar_ns.plugin.option_order import led_by
from rgbavatar_ns.plugin.presets import presets
from rgbavatar_ns.plugin.training.run_end import EndingTrainer

HEAVY = ("mediapipe", "trimesh", "embreex", "matplotlib.pyplot", "skimage", "gaussforge", "ray")


_LISTED = f"""
import inspect, sys
original, searched = inspect.ismodule, 0
def counted(thing):
    global searched
    searched += 1
    return original(thing)
inspect.ismodule = counted
import nerfstudio.scripts.train
from nerfstudio.configs.method_configs import all_methods
print('rgbavatar-tiny' in all_methods, [name for name in {HEAVY} if name in sys.modules])
print(searched / len(sys.modules))
"""


@pytest.fixture(scope="module")
def listed() -> subprocess.CompletedProcess[str]:
    """What a fresh process that lists the methods prints."""
    return subprocess.run([sys.executable, "-c", _LISTED], capture_output=True, text=True)


def test_listing_the_methods_prints_no_warning_and_loads_nothing_that_only_other_work_needs(
    listed: subprocess.CompletedProcess[str],
) -> None:
    assert listed.stdout.splitlines()[0] == "True []"
    assert listed.stderr == ""


def test_the_frames_of_import_are_not_searched_for_among_all_modules(
    listed: subprocess.CompletedProcess[str],
) -> None:
    """nerfstudio looks at the stack for each of 26 methods that could be installed.

    For two frames a look, of code that no file has, all modules are gone through three times; with
    those of `import` it were 36 times.
    """
    assert float(listed.stdout.splitlines()[1]) < 12 * 26


def test_the_commands_own_help_needs_neither_torch_nor_nerfstudio() -> None:
    code = (
        "import sys\nfrom rgbavatar_ns.cli.main import main\nmain(['--help'])\n"
        "print([name for name in ('torch', 'nerfstudio', 'tyro', 'numpy') if name in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("name", ["rgbavatar", "rgbavatar-online", "flashavatar-style"])
def test_help_leads_with_what_people_change_first(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    with pytest.raises(SystemExit):
        tyro.cli(AnnotatedBaseConfigUnion, args=[name, "--help"])
    shown = capsys.readouterr().out
    order = [shown.index(f"{option} ") for option in ("--data", "--max-num-iterations", "--vis")]
    assert order == sorted(order)
    assert order[-1] < shown.index("--project-name ")
    groups = [
        shown.index(f" {group} options ") for group in ("pipeline.model", "viewer", "machine")
    ]
    assert groups == sorted(groups)


def test_an_order_of_options_changes_neither_values_nor_positions() -> None:
    @dataclass
    class Plain:
        a: int = 1
        b: int = 2
        c: int = 3

    led = led_by("c", "a")(Plain)
    assert [field.name for field in fields(led)] == ["c", "a", "b"]
    assert led(10, 20) == led(a=10, b=20, c=3)
    with pytest.raises(KeyError):
        led_by("d")(led)


def test_the_viewer_that_stays_open_says_how_it_ends_and_how_not_to_have_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    trainer = SimpleNamespace(viewer_state=Mock(), stop=Mock(signal_number=2))
    trainer.stop.wait.side_effect = [False, True]
    EndingTrainer._train_complete_viewer(trainer)  # type: ignore[arg-type]
    told = capsys.readouterr().out
    assert "stays open; Ctrl-C ends it" in told
    option, value = "--viewer.quit-on-train-completion", "True"
    assert f"{option} {value}" in told
    assert hasattr(presets()["rgbavatar"].viewer, option.partition(".")[2].replace("-", "_"))
    assert trainer.stop.signal_number is None, "the run has ended well"
    assert trainer.stop.wait.call_count == 2
