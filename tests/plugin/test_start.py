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


_COUNTED = """
import inspect, sys
original, searched = inspect.ismodule, 0
def counted(thing):
    global searched
    searched += 1
    return original(thing)
inspect.ismodule = counted
"""


def test_listing_the_methods_prints_no_warning_and_loads_nothing_that_only_other_work_needs() -> (
    None
):
    code = _COUNTED + (
        "import nerfstudio.scripts.train\n"
        "from nerfstudio.configs.method_configs import all_methods\n"
        f"print('rgbavatar-tiny' in all_methods, [n for n in {HEAVY} if n in sys.modules])\n"
        "print(searched / len(sys.modules))"
    )
    started = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    listed, searches = started.stdout.split("\n", 1)
    assert listed == "True []"
    assert started.stderr == ""
    # nerfstudio looks at the stack 26 times; for two frames, of code that no file has, `inspect`
    # goes through all modules, three times each. With the frames of `import` it were 36 times.
    assert float(searches) < 12 * 26


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
