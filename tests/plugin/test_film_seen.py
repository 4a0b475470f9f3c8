"""What the viewer tells of the film while training changes what it shows."""

from dataclasses import replace

import pytest
import torch
import viser

from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from rgbavatar_ns.plugin.viewer.driving import training_statistics
from rgbavatar_ns.plugin.viewer.film_seen import FilmSeen
from rgbavatar_ns.plugin.viewer.panel import ViewerPanel
from rgbavatar_ns.plugin.viewer.widgets import Widgets
from tests.plugin.fake_viewer import FakeViewer


def test_sliders_follow_what_training_changes_until_it_has_ended(pipeline: RGBAvatarPipeline):
    now, viewer = [0.0], FakeViewer(training="training")
    panel = ViewerPanel(pipeline.model, pipeline.film, clock=lambda: now[0])
    panel.attach(viewer)
    weights = pipeline.model.avatar.weights
    slider = viewer.gui["Basis 2"]
    steps = (  # The weights grow so many times; what the slider shows then of them, after so long.
        (10.0, 0.0, "training", 10.0),
        (20.0, 0.5, "training", 10.0),
        (20.0, 1e4, "training", 20.0),
        (torch.nan, 1e4, "training", 20.0),
        (30.0, 0.0, "completed", 30.0),
        (40.0, 1e4, "completed", 30.0),
    )
    try:
        first = training_statistics(pipeline.model)
        for grown, seconds, viewer.trainer.training_state, shown in steps:
            pipeline.model.avatar.weights = lambda theta, by=grown: by * weights(theta)
            now[0] += seconds
            panel.tick()
            low, high, step, _ = slider.limits
            ends = sorted({shown * float(first.psi_min[1]), shown * float(first.psi_max[1])})
            assert list(slider.options["marks"]) == pytest.approx(ends, abs=step)
            assert f"in training {slider.options['marks'][0]:g} to" in slider.options["hint"]
            assert max(high, -low) == pytest.approx(1.5 * max(ends[-1], -ends[0], 2 / 3), abs=step)
            assert slider.options["precision"] == len(f"{step:g}".partition(".")[2])
    finally:
        del pipeline.model.avatar.weights


def test_viser_takes_other_ends_for_a_slider_that_is_there(pipeline: RGBAvatarPipeline):
    panel, seen = ViewerPanel(pipeline.model, pipeline.film), FilmSeen(pipeline.model)
    wider = replace(seen.statistics, psi_max=seen.statistics.psi_max + 40)
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        widgets = Widgets(server.gui, panel, seen.sliders, seen.statistics, 2, 25.0)
        widgets.renew(seen.sliders, wider)
        theta, count = torch.zeros(len(seen.sliders)), len(wider.psi_max)
        widgets.show_driving(theta, torch.full((count,), 40.0))
        handles = server.gui._gui_input_handle_from_id.values()
        assert sum(handle.value == pytest.approx(40.0) for handle in handles) == count
    finally:
        server.stop()
