"""A live performance in the viewer's panel."""

import threading

import pytest
import torch

from rgbavatar_ns.driving.live_drive import DrivenFrame
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.live_viewer import ViewerOutput
from rgbavatar_ns.plugin.viewer.viewer_state import ViewerState
from tests.plugin.desk import Desk


def _frame(index: int, theta: torch.Tensor) -> DrivenFrame:
    return DrivenFrame(index, theta, float(index), index / 25)


def test_a_performer_is_shown_until_the_user_chooses_otherwise(desk: Desk):
    seen: list[ViewerState] = []
    asked = threading.Event()
    desk.panel.listen_live(asked.set, seen.append)
    first, second = desk.model.frame_theta[3], desk.model.frame_theta[5]
    desk.panel.show_live(_frame(1, first))
    assert desk.panel.state.driven_by == "live performer"
    assert desk.viewer.gui["Driven by"].value == "live performer"
    assert torch.equal(desk.picture(), desk.white(first[None]))
    assert seen[-1].live is not None
    assert seen[-1].live.index == 1
    desk.panel.show_live(_frame(2, second))
    assert torch.equal(desk.picture(), desk.white(second[None]))
    desk.viewer.gui["Calibrate"].user_clicks()
    assert asked.is_set()
    desk.set("Frame", 0)
    desk.panel.show_live(_frame(3, first))
    assert torch.equal(desk.picture(), desk.white(desk.model.frame_theta[0:1]))
    desk.set("Driven by", "live performer")
    assert torch.equal(desk.picture(), desk.white(first[None]))


def test_each_frame_asks_for_a_picture(desk: Desk):
    desk.panel.show_live(_frame(1, desk.model.frame_theta[3]))
    before = len(desk.asked)
    desk.panel.show_live(_frame(2, desk.model.frame_theta[4]))
    assert len(desk.asked) == before + 1


def test_without_a_performer_it_says_how_to_get_one(desk: Desk):
    desk.set("Driven by", "live performer")
    assert desk.panel.state.driven_by == "dataset frame"
    assert "rgbavatar drive" in desk.told()


def test_what_is_no_run_is_told(tmp_path):
    (tmp_path / "file.ckpt").write_text("")
    with pytest.raises(UserError, match="is no run of ns-train"):
        ViewerOutput(tmp_path / "file.ckpt", lambda: None)
