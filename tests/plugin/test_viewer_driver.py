"""Another's performance in the viewer's panel: loaded, shown and played as it was filmed."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rgbavatar_ns.driving.theta_map import MappedTheta
from rgbavatar_ns.plugin.viewer import panel
from tests.plugin.desk import Desk
from tests.plugin.tiny import tiny_dataset


def test_a_driver_plays_on_this_avatar(desk: Desk, tmp_path: Path):
    other = tiny_dataset(tmp_path / "other", frames=6, test=1)
    desk.panel.load_driver(str(tmp_path / "other"), "off")
    state = desk.panel.state
    assert (state.driven_by, len(state.sequence)) == ("driving sequence", 6)
    jaw = desk.model.avatar.layout.slice("jaw")
    assert torch.allclose(state.sequence[:, jaw], other.theta[:, jaw])
    first = desk.picture()
    desk.set("Driver's frame", 3)
    assert (desk.picture() - first).abs().max() > 0.01
    desk.panel.advance()
    assert desk.panel.state.sequence_frame == 4
    # Its pictures are another person's: there is nothing to compare with.
    desk.panel.change(picture="error")
    assert desk.picture().shape == first.shape
    assert "no film to compare" in desk.told()


def test_film_and_driver_play_at_their_own_rates(desk: Desk, tmp_path: Path):
    films = desk.panel.state.frames_per_second
    for name, rate in (("first", 50.0), ("second", 29.97)):
        tiny_dataset(tmp_path / name, frames=3, test=1)
        _written(tmp_path / name, frames_per_second=rate)

    def rates() -> tuple[float, float]:
        return desk.panel.state.frames_per_second, desk.viewer.gui["Frames/s"].value

    desk.panel.load_driver(str(tmp_path / "first"), "off")
    assert rates() == (50.0, 50)
    desk.panel.load_driver(str(tmp_path / "second"), "off")
    assert rates() == (29.97, 30)
    desk.set("Frames/s", 10)
    desk.set("Jaw opens (°)", 20.0)
    desk.set("Driven by", "driving sequence")
    assert rates() == (10.0, 10), "what the user chose stays while the same is played"
    desk.set("Driven by", "dataset frame")
    assert rates() == (films, round(films))
    desk.set("Driven by", "driving sequence")
    assert rates() == (29.97, 30)
    desk.set("Frame", 3)
    assert rates() == (films, round(films))


def test_of_a_driver_that_several_cameras_filmed_one_film_is_played(desk: Desk, tmp_path: Path):
    other = tiny_dataset(tmp_path / "other", frames=6, test=1)
    _written(tmp_path / "other", camera_name=list("ababab"), timestep=[0, 0, 1, 1, 2, 2])
    desk.panel.load_driver(str(tmp_path / "other"), "off")
    jaw = desk.model.avatar.layout.slice("jaw")
    assert torch.allclose(desk.panel.state.sequence[:, jaw], other.theta[::2, jaw])
    assert desk.viewer.gui["Driver's frame"].limits[1] == 2
    assert desk.told().count("3 frames of") == 1


def test_what_a_driver_has_of_its_own_is_told(desk: Desk, tmp_path: Path, monkeypatch):
    tiny_dataset(tmp_path / "other", frames=3, test=1)

    def mapped(*given: object) -> MappedTheta:
        return replace(driven_by(*given), unmapped=("pout",), told="its expressions are fitted")

    driven_by = panel.driven_by
    monkeypatch.setattr(panel, "driven_by", mapped)
    desk.panel.load_driver(str(tmp_path / "other"), "off")
    assert "not known to the avatar: pout, its expressions are fitted" in desk.told()


def _written(folder: Path, frames_per_second: float = 25.0, **columns: list[object]) -> None:
    """Give a dataset this rate, and its frames these entries."""
    index = json.loads((folder / "dataset.json").read_text())
    for name, values in columns.items():
        for frame, value in zip(index["frames"], values):
            frame[name] = value
    index["frames_per_second"] = frames_per_second
    (folder / "dataset.json").write_text(json.dumps(index))


@pytest.mark.parametrize("folder", ["", "/nowhere/at/all"])
def test_a_driver_that_is_none_is_told_in_the_panel(desk: Desk, folder: str):
    desk.panel.load_driver(folder, "neutral")
    assert desk.panel.state.driven_by == "dataset frame"
    assert "Cannot be shown" in desk.told()


def test_the_sequence_cannot_be_chosen_before_it_is_there(desk: Desk):
    desk.set("Driven by", "driving sequence")
    assert "Load a driver" in desk.told()
    assert desk.viewer.gui["Driven by"].value == "dataset frame"
