"""The panel: what its controls do to the picture, without a browser."""

from collections.abc import Callable

import pytest
import torch
import viser
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerControl

from rgbavatar_ns.plugin.cameras import from_nerfstudio
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from rgbavatar_ns.plugin.viewer.driving import training_statistics
from rgbavatar_ns.plugin.viewer.panel import ViewerPanel
from rgbavatar_ns.plugin.viewer.sliders import on_step
from rgbavatar_ns.plugin.viewer.viewpoint import Viewpoint
from tests.plugin.desk import Desk, rendered, rendered_depth
from tests.plugin.fake_viewer import FakeViewer
from tests.plugin.tiny import NUM_FRAMES


def test_without_a_viewer_the_cameras_time_chooses_and_the_ground_is_black(
    pipeline: RGBAvatarPipeline,
):
    model = pipeline.model
    camera = pipeline.datamanager.train_dataset.cameras[0:1]
    camera.metadata = {"cam_idx": None}
    for share, position in ((0.0, 0), (0.51, 7), (1.0, 13), (1.5, 13), (-1.0, 0)):
        camera.times = torch.tensor([[share]])
        theta = model.frame_theta[position : position + 1]
        expected = rendered(model.avatar, theta, camera, to_be_seen=False)
        drawn = model.get_outputs_for_camera(camera)
        assert torch.equal(drawn["rgb"], expected)
        assert drawn["depth"].shape == drawn["accumulation"].shape == (*expected.shape[:2], 1)


@pytest.mark.parametrize(
    "shown", [{"layer_depth": True}, {"output_render": "depth"}, {"split": True}]
)
def test_depth_is_found_where_the_viewer_shows_it_and_no_output_goes_away(desk: Desk, shown: dict):
    camera = from_nerfstudio(desk.camera())
    plain = desk.panel.draw(camera, None)
    assert plain["depth"].isnan().all()
    vars(desk.viewer.control_panel).update(shown)
    drawn = desk.panel.draw(camera, None)
    assert list(drawn) == list(plain)
    assert drawn["depth"].shape == plain["depth"].shape
    covered = drawn["accumulation"] > 0.5
    depth = rendered_depth(desk.model.avatar, desk.model.frame_theta[:1], desk.camera())
    assert torch.equal(drawn["depth"][covered], depth[covered])
    assert torch.equal(drawn["rgb"], plain["rgb"])


def test_a_cameras_own_theta_comes_before_the_panel(pipeline: RGBAvatarPipeline):
    camera, _ = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    drawn = pipeline.model.get_outputs_for_camera(camera)["rgb"]
    theta = camera.metadata["theta"]
    expected = rendered(pipeline.model.avatar, theta, camera, to_be_seen=False)
    assert torch.equal(drawn.clamp(0, 1), expected)


def test_frame_slider_shows_that_frame_over_the_background(desk: Desk):
    desk.set("Frame", 7)
    assert torch.equal(desk.picture(), desk.white(desk.model.frame_theta[7:8]))
    assert len(desk.asked) == 1
    desk.set("Background", (255, 51, 0))
    assert torch.allclose(desk.picture()[0, 0], torch.tensor([1.0, 0.2, 0.0]), atol=1e-6)


def test_what_nobody_reads_is_neither_asked_nor_told(desk: Desk, monkeypatch):
    asked, told, weights = [], [], desk.model.avatar.weights
    monkeypatch.setattr(
        desk.model.avatar, "weights", lambda theta: asked.append(1) or weights(theta)
    )
    monkeypatch.setattr(desk.panel, "_beyond", lambda *_: told.append(1) or "far out")
    for frame in (2, 5, 7):
        desk.panel.change(frame=frame)
        desk.picture()
    assert not asked
    assert not told
    assert "Far out" in desk.told()
    assert len(asked) == len(told) == 1


def test_moving_a_face_slider_drives_by_hand_from_what_is_shown_and_back(desk: Desk):
    desk.set("Frame", 5)
    before = desk.picture()
    desk.set("Jaw opens (°)", 20.0)
    expected = desk.model.frame_theta[5].clone()
    expected[desk.model.avatar.layout.slice("jaw").start] = torch.pi / 9
    assert torch.allclose(desk.panel.state.theta_by_hand, expected, atol=1e-6)
    assert (desk.picture() - before).abs().max() > 0.01
    desk.set("Driven by", "dataset frame")
    assert torch.equal(desk.picture(), before)


def test_sliders_stand_where_the_frame_that_drives_has_its_numbers(desk: Desk):
    theta, layout = desk.model.frame_theta, desk.model.avatar.layout
    for frame in (7, 2):
        desk.set("Frame", frame)
        desk.picture()
        desk.pass_time(1.0)
        gui, jaw = desk.viewer.gui, theta[frame, layout.slice("jaw")][0].rad2deg().item()
        shown, (_, _, step, _) = gui["Jaw opens (°)"].value, gui["Jaw opens (°)"].limits
        assert abs(shown - jaw) <= step / 2 + 1e-6
        assert len(f"{shown:g}") <= 5
        psi = desk.model.avatar.weights(theta[frame][None])[0, 1].item()
        assert gui["Basis 2"].value == pytest.approx(psi, abs=0.02)
    # Following is no change: the frame drives on.
    assert desk.panel.state.driven_by == "dataset frame"
    assert len(desk.asked) == 2


def test_a_slider_that_a_user_moves_is_not_pushed_about(desk: Desk):
    label = "Jaw opens (°)"
    moved = desk.viewer.gui[label].limits[2] * 12.4
    desk.set(label, moved)
    desk.picture()
    desk.pass_time(1.0)
    assert desk.viewer.gui[label].value == moved


def test_every_number_fits_its_field_and_every_label_wraps(desk: Desk):
    for handle in desk.viewer.gui.handles:
        if handle.kind == "slider":
            low, high, step, _ = handle.limits
            for end in (low + step, high - step, low, high):
                assert len(f"{on_step(float(end), float(step)):g}") <= 5, handle.label
            assert max(map(len, handle.label.split())) <= 12, handle.label
    hints = [h.options.get("hint") for h in desk.viewer.gui.handles if h.label.startswith("Basis ")]
    assert len(hints) == desk.model.avatar.config.num_bases
    assert all("in training" in hint for hint in hints)
    (alone,) = (h for h in desk.viewer.gui.handles if h.label == "Show one alone")
    assert "Exaggerate" in alone.options["hint"], "the factor is not 1 at first"


def test_training_is_steered_only_while_it_runs(desk: Desk, pipeline: RGBAvatarPipeline):
    viewer = FakeViewer(training="training")
    panel = ViewerPanel(pipeline.model, pipeline.film, clock=lambda: 0.0)
    panel.attach(viewer)
    panel.tick()
    assert viewer.pause_train.visible
    viewer.trainer.training_state = "completed"
    panel.tick()
    desk.pass_time(0.0)  # ns-viewer's, without a trainer
    for each in (viewer, desk.viewer):
        for control in (each.pause_train, each.resume_train, *each.steering):
            assert not control.visible


def test_quick_pictures_become_finer_once(desk: Desk, monkeypatch: pytest.MonkeyPatch):
    resolution = desk.viewer.control_panel._max_res
    for seconds, shown in ((0.2, 512), (0.01, 1024)):
        resolution.value = 512
        camera = desk.camera()
        camera.width, camera.height = (torch.full_like(camera.width, n) for n in (512, 256))
        monkeypatch.setattr(desk.panel, "_clock", _ticking(desk, seconds))
        desk.panel.draw(from_nerfstudio(camera), None)
        monkeypatch.undo()
        desk.pass_time(1.0)
        assert resolution.value == shown
    resolution.value = 512  # A user's choice stays.
    desk.picture()
    desk.pass_time(1.0)
    assert resolution.value == 512


def _ticking(desk: Desk, seconds: float) -> Callable[[], float]:
    def clock() -> float:
        desk.now_s += seconds
        return desk.now_s

    return clock


def test_sliders_show_the_film_and_what_leaves_it_is_told(desk: Desk):
    seen, layout = training_statistics(desk.model), desk.model.avatar.layout
    jaw, place = desk.viewer.gui["Jaw opens (°)"], layout.slice("jaw").start
    assert jaw.limits[0] == 0, "a jaw only opens"
    filmed = seen.theta_max[place].rad2deg().item()
    assert jaw.options["marks"][-1] == pytest.approx(filmed, abs=jaw.limits[2])
    assert jaw.limits[1] > 1.1 * filmed, "it goes on beyond"
    desk.panel.show_neutral()
    desk.picture()
    assert "eyond the film" not in desk.told()
    desk.set("Jaw opens (°)", jaw.limits[1])
    desk.picture()
    assert "Beyond the film: Jaw opens (°)" in desk.told()
    camera = desk.camera()
    turn = torch.eye(3)[[1, 0, 2]] * torch.tensor([[1.0], [-1.0], [1.0]])  # a quarter about z: up
    camera.camera_to_worlds = turn @ camera.camera_to_worlds
    desk.picture(camera)
    assert "the head's turn" in desk.told()


def test_play_by_hand_plays_the_film(desk: Desk):
    desk.set("Jaw opens (°)", 20.0)
    desk.set("Play", True)
    assert desk.panel.state.driven_by == "dataset frame"


def test_echoes_of_moved_sliders_change_nothing(desk: Desk):
    desk.viewer.gui["Neutral"].user_clicks()
    neutral = training_statistics(desk.model).theta_neutral
    assert torch.equal(desk.panel.state.theta_by_hand, neutral)
    assert len(desk.asked) == 1


def test_random_expressions_stay_within_what_was_seen(desk: Desk):
    seen, layout = training_statistics(desk.model), desk.model.avatar.layout
    pose = desk.panel.theta_shown()[layout.slice("rotation")]
    drawn = []
    for _ in range(20):
        desk.viewer.gui["Random expression"].user_clicks()
        drawn.append(desk.panel.state.theta_by_hand)
    angles = torch.stack(drawn)[:, layout.slice("jaw").start]
    # Only the jaw moves in this film, so its range is the whole of it.
    low, high = seen.theta_min, seen.theta_max
    numbers = layout.slice("jaw").start
    assert low[numbers] - 1e-5 <= angles.min() < angles.max() <= high[numbers] + 1e-5
    assert angles.max() - angles.min() > 0.3 * (high[numbers] - low[numbers])
    assert all(torch.equal(theta[layout.slice("rotation")], pose) for theta in drawn)


def test_colours_beyond_white_stay_white(desk: Desk):
    bright = desk.model.avatar.blendshapes.color_feature
    before = bright.detach().clone()
    try:
        with torch.no_grad():
            bright.add_(3.0)
            camera = from_nerfstudio(desk.camera())
            drawn = desk.model.avatar.render(desk.model.frame_theta[:1], camera).image
        assert drawn.max() > 1.05
        assert desk.picture().max() <= 1
    finally:
        bright.data.copy_(before)


def test_a_weight_slider_overrides_the_network_until_it_is_given_back(desk: Desk):
    before = desk.picture()
    theta = desk.model.frame_theta[0:1]
    psi = desk.model.avatar.weights(theta).detach()
    desk.set("Basis 2", 0.9)
    psi[0, 1] = 0.9
    assert torch.allclose(desk.panel.state.psi_by_hand, psi[0])
    assert torch.allclose(desk.picture(), desk.white(theta, psi), atol=1e-5)
    assert (desk.picture() - before).abs().max() > 0.005
    desk.set("Hold weights", False)
    assert torch.equal(desk.picture(), before)


def test_bases_used_counts_the_first_ones(desk: Desk):
    theta = desk.model.frame_theta[0:1]
    psi = desk.model.avatar.weights(theta).detach()
    desk.set("Bases used", 1)
    psi[:, 1:] = 0
    assert torch.allclose(desk.picture(), desk.white(theta, psi), atol=1e-5)


def test_one_basis_alone_is_base_and_basis_on_the_neutral_frame(desk: Desk):
    seen = training_statistics(desk.model)
    extreme = torch.where(seen.psi_max >= -seen.psi_min, seen.psi_max, seen.psi_min)
    desk.set("Show one alone", "3")
    psi = torch.zeros(1, len(extreme))
    psi[0, 2] = 1.5 * extreme[2]
    assert torch.allclose(desk.picture(), desk.white(seen.theta_neutral[None], psi), atol=1e-5)
    desk.set("Show one alone", "none")
    assert torch.equal(desk.picture(), desk.white(desk.model.frame_theta[0:1]))


def test_trouble_is_told_and_the_plain_avatar_drawn(desk: Desk):
    plain = desk.picture()
    desk.panel.change(psi_by_hand=torch.zeros(99))
    assert torch.equal(desk.picture(), plain)
    assert "Cannot be shown" in desk.told()


def test_playing_goes_round(desk: Desk):
    desk.panel.change(frame=NUM_FRAMES - 2)
    seen = []
    for _ in range(3):
        desk.panel.advance()
        seen.append(desk.panel.state.frame)
    assert seen == [NUM_FRAMES - 1, 0, 1]
    desk.panel.show_neutral()
    before = desk.panel.state
    desk.panel.advance()
    assert desk.panel.state is before


def test_play_moves_on_once_a_picture_was_drawn(desk: Desk):
    desk.set("Frames/s", 10)
    desk.set("Play", True)
    desk.picture()
    desk.pass_time(0.1)
    assert desk.panel.state.frame == 1
    desk.pass_time(0.2)
    assert desk.panel.state.frame == 1  # it has not been seen yet
    desk.picture()
    desk.pass_time(0.01)
    assert desk.panel.state.frame == 2
    desk.picture()
    desk.pass_time(0.05)
    assert desk.panel.state.frame == 2  # ten a second
    desk.pass_time(10.0)
    assert desk.panel.state.frame == 3
    desk.pass_time(10.0)
    assert desk.panel.state.frame == 4  # nobody draws, which does not stop it for ever
    desk.set("Play", False)
    desk.pass_time(10.0)
    assert desk.panel.state.frame == 4


def test_previewing_a_camera_path_follows_its_time(desk: Desk):
    desk.panel.change(frame=7, mesh=True)
    desk.viewer.render_tab_state.preview_render = True
    assert torch.equal(desk.picture(time=0.9), desk.white(desk.model.frame_theta[12:13]))


def test_viewer_starts_before_the_face_and_nearer_than_the_camera(desk: Desk):
    start = Viewpoint.before(desk.model.avatar, desk.model.subject)
    eye, look_at = torch.tensor(start.eye), torch.tensor(start.look_at)
    # The tiny dataset's camera stands one metre before the head, on the face's side: -y.
    offset = eye - look_at
    assert -1.0 < offset[1] < -0.7
    assert offset[[0, 2]].norm() < 0.1


def test_nerfstudio_finds_the_panel_and_viser_shows_it(pipeline: RGBAvatarPipeline):
    ((_, panel),) = parse_object(pipeline, ViewerControl, "Custom Elements")
    assert pipeline.viewer_panel is panel
    panel = ViewerPanel(pipeline.model, pipeline.film)
    viewer = FakeViewer()
    viewer.viser_server = server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        panel.attach(viewer)
        panel.show_neutral()
        panel.tell("shown")
    finally:
        server.stop()
