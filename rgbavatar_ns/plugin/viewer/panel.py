"""The avatar's panel in nerfstudio's viewer: its state, what changes it, and the playing clock."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.viewer.viewer_elements import ViewerControl
from torch import Tensor

from rgbavatar_ns.data import TrackedDataset, load_dataset
from rgbavatar_ns.driving.live_drive import DrivenFrame
from rgbavatar_ns.driving.transfer import DrivingOptions
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import dataset_folder
from rgbavatar_ns.export.scenes import driven_by
from rgbavatar_ns.head import ThetaLayout, turn_seen
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.plugin.avatar_model import AvatarModel
from rgbavatar_ns.plugin.film_path import FilmMoment
from rgbavatar_ns.plugin.viewer.client import serve_sharp_client
from rgbavatar_ns.plugin.viewer.driving import (
    DrivingSignal,
    driving_signal,
    neutral_of_shown,
    random_expression,
    training_statistics,
)
from rgbavatar_ns.plugin.viewer.film_seen import FilmSeen
from rgbavatar_ns.plugin.viewer.render import ViewerRender, viewer_render
from rgbavatar_ns.plugin.viewer.render_thread import ask_for_pictures, draw_by_render_threads
from rgbavatar_ns.plugin.viewer.viewer_state import DrivenBy, ViewerState
from rgbavatar_ns.plugin.viewer.viewpoint import Viewpoint
from rgbavatar_ns.plugin.viewer.widgets import Widgets
from rgbavatar_ns.threads import using_threads

_TICK_S = 0.01
_PATIENCE_S = 5.0
_TOLD_EVERY_S = 0.3
# nerfstudio's "Max res", and what a picture of that size takes where twice that is quick as well.
_PLAIN_PX = 512
_QUICK_S = 0.04
_ALL_BASES: dict[str, Any] = {"basis_alone": None, "bases_used": None}


@dataclass(frozen=True)
class _Report:
    """What is to be told about a picture, some of them."""

    trouble: str
    seconds: float
    width_px: int
    height_px: int
    psnr_db: float | None
    world_to_camera: Float[Tensor, "1 4 4"]
    signal: DrivingSignal

    def text(self, layout: ThetaLayout, beyond: Callable[..., str]) -> str:
        """Size, speed, score, and what goes `beyond` the film."""
        size = f"{self.width_px} x {self.height_px}"
        rate = f"{1 / max(self.seconds, 1e-6):.0f} frames/s"
        psnr = "" if self.psnr_db is None else f"  \nPSNR of this frame {self.psnr_db:.2f} dB"
        theta = self.signal.theta.cpu()
        told = beyond(theta, turn_seen(theta, self.world_to_camera, layout))
        told = f"  \n{told[:1].upper()}{told[1:]}" if told else ""
        return f"{size} in {1e3 * self.seconds:.0f} ms: {rate}{psnr}{told}"


class ViewerPanel(ViewerControl):
    """Draws what its controls ask for, where a camera brings no theta of its own.

    Without a viewer (`ns-render`) the camera's time or moment chooses the frame, over black. `film`
    is what pictures are compared with, if there is anything; `clock` counts seconds.
    """

    def __init__(
        self,
        model: AvatarModel,
        film: TrackedDataset | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.state = ViewerState(driven_by="viewer's time")
        self._model, self._film, self._clock = model, film, clock
        self._viewer: Any = None
        self._widgets: Widgets | None = None
        self._seen: FilmSeen | None = None
        self._beyond: Callable[..., str] = lambda theta, turns: ""
        self._changing = threading.RLock()
        self._report: _Report | None = None
        self._told = self._played = self._report
        self._next_told_s = self._next_frame_s = self._played_s = 0.0
        self._may_refine = True
        self._rates: dict[DrivenBy, float] = {}
        self._plays: DrivenBy = "dataset frame"
        self._calibrate: Callable[[], None] = lambda: None
        self._drawn_live: Callable[[ViewerState], None] = lambda state: None
        serve_sharp_client()

    def _setup(self, viewer: Any) -> None:
        """Called by nerfstudio's viewer."""
        super()._setup(viewer)
        self.attach(viewer)
        threading.Thread(target=self._tick_forever, name="viewer panel", daemon=True).start()

    def attach(self, viewer: Any) -> None:
        """Add the controls to nerfstudio's viewer; from now on `tick` is due all the time."""
        self._viewer = viewer
        draw_by_render_threads(viewer)
        self.state = ViewerState(background=(1.0, 1.0, 1.0))
        if self._film is not None:
            self.state = replace(self.state, frames_per_second=self._film.playback_rate)
        self._seen = seen = FilmSeen(self._model)
        self._beyond = seen.beyond
        gui = viewer.viser_server.gui
        self._rates["dataset frame"] = rate = self.state.frames_per_second
        self._widgets = Widgets(gui, self, seen.sliders, seen.statistics, self._num_frames, rate)
        viewpoint = Viewpoint.before(self._model.avatar, self._model.subject)
        viewer.viser_server.scene.set_up_direction("+z")
        viewer.viser_server.on_client_connect(viewpoint.place)

    @property
    def attached(self) -> bool:
        """Whether there is a viewer."""
        return self._viewer is not None

    def draw(
        self, camera: PinholeCameras, time_share: float | FilmMoment | None
    ) -> dict[str, Tensor]:
        """The picture for one camera (C = 1): rgb, accumulation, depth [H W C].

        What cannot be shown is told in the panel, and the plain avatar stands in its place:
        nothing here may end the viewer's thread, or training.
        """
        state, began_s = self._present(), self._clock()
        trouble = ""
        try:
            signal, drawn = self._drawn(state, camera, time_share)
        except Exception as error:
            if self._widgets is None:
                raise
            trouble = _in_words(error)
            plain = ViewerState(state.driven_by, state.frame, background=state.background)
            signal, drawn = self._drawn(plain, camera, time_share)
        self._report = _Report(
            trouble,
            self._clock() - began_s,
            camera.width,
            camera.height,
            drawn.psnr,
            camera.world_to_camera.cpu(),
            signal,
        )
        self._drawn_live(state)
        return drawn.outputs()

    def tick(self) -> None:
        """What time brings: the next frame, a picture that was lost, how the last was drawn."""
        now_s, report = self._clock(), self._report
        drawn = report is not self._played or now_s > self._played_s + _PATIENCE_S
        if self.state.playing and drawn and now_s >= self._next_frame_s:
            frame_s = 1 / max(self.state.frames_per_second, 1e-3)
            late = now_s > self._next_frame_s + frame_s
            self._next_frame_s = frame_s + (now_s if late else self._next_frame_s)
            self._played, self._played_s = report, now_s
            self.advance()
        if self._widgets is None or self._seen is None:
            return
        self._hide_training()
        trainer = self._viewer.trainer
        if self._seen.look_again(now_s, trainer and trainer.training_state):
            self._widgets.renew(self._seen.sliders, self._seen.statistics)
        if report is not None and report is not self._told and now_s >= self._next_told_s:
            self._told, self._next_told_s = report, now_s + _TOLD_EVERY_S
            self._widgets.report(report.text(self._model.avatar.layout, self._beyond))
            signal = report.signal
            self._widgets.show_driving(signal.theta[0].cpu(), self._psi_of(signal)[0].cpu())
            self._refine(report)
            if report.trouble:
                self._widgets.tell(report.trouble)

    def change(self, **values: Any) -> None:
        """Replace parts of the state by name and draw anew, if any is another than before.

        Film and driver play at their own rates: whichever comes in the other's place brings its.
        """
        with self._changing:
            plays = values.get("driven_by", self._plays)
            if plays in self._rates and plays != self._plays:
                self._plays = plays
                values = {"frames_per_second": self._rates[plays]} | values
            if all(_same(getattr(self.state, name), value) for name, value in values.items()):
                return
            self.state = replace(self.state, **values)
        self._refresh()

    def drive_by(self, driven_by: DrivenBy) -> None:
        """Choose what drives; by hand starts from what is shown."""
        if driven_by == "by hand":
            self.set_theta(self.theta_shown())
        elif driven_by == "live performer" and self.state.live is None:
            self.tell("Nobody performs: start `rgbavatar drive RUN --show viewer`.")
            self._refresh()
        elif driven_by == "driving sequence" and self.state.sequence is None:
            self.tell("Load a driver first: a dataset or a run, in the folder 'Driver'.")
            self._refresh()
        else:
            self.change(driven_by=driven_by)

    def set_theta(self, theta: Float[Tensor, "H"]) -> None:
        """Drive by hand with these numbers."""
        self.change(driven_by="by hand", theta_by_hand=theta.clone())

    def set_theta_number(self, place: int, value: float) -> None:
        """Drive by hand, with one number of theta changed from what is shown."""
        theta = self.theta_shown().clone()
        theta[place] = value
        self.set_theta(theta)

    def show_neutral(self) -> None:
        """Drive by hand: the frame with the most neutral expression, of a stream the newest."""
        self.set_theta(neutral_of_shown(self._model))

    def show_random_expression(self) -> None:
        """Drive by hand: a random expression within what was seen, on the pose shown."""
        self.set_theta(random_expression(training_statistics(self._model), self.theta_shown()))

    def set_weight(self, basis: int, value: float) -> None:
        """Set one weight by hand; the others stay what the network or the hand gave them."""
        psi = self._psi_shown().clone()
        psi[basis] = value
        self.change(psi_by_hand=psi, basis_alone=None)

    def hold_weights(self, by_hand: bool) -> None:
        """Hold the weights where they are, or give them back to the network."""
        self.change(psi_by_hand=self._psi_shown() if by_hand else None)

    def play(self, on: bool) -> None:
        """Move on by itself, or stay; where nothing can be played, the film's frames are."""
        played: tuple[DrivenBy, ...] = ("dataset frame", "driving sequence")
        driven_by = self.state.driven_by
        if on and driven_by not in played:
            driven_by = "dataset frame"
        self.change(playing=on, driven_by=driven_by)

    def load_driver(self, folder: str, relative: str) -> None:
        """Read another person's performance and play it; what is wrong is told in the panel."""
        self.tell(f"Reading {folder} ...")
        try:
            if not folder.strip():
                raise UserError("No driver is named.", "Type the folder of a dataset or run.")
            driver = load_dataset(dataset_folder(Path(folder.strip()).expanduser()))
            mapped = driven_by(
                self._model.avatar,
                driver,
                driver.of_one_camera(range(len(driver))),
                training_statistics(self._model),
                driver.playback_rate,
                DrivingOptions(relative=relative),  # type: ignore[arg-type]
            )
        except Exception as error:  # In one of the viewer's threads nobody would see it.
            self.tell(_in_words(error))
            return
        if self._widgets is not None:
            self._widgets.offer_sequence(len(mapped.theta))
        unknown = ", ".join(mapped.unmapped)
        left_out = f", not known to the avatar: {unknown}" if unknown else ""
        left_out += mapped.told and f", {mapped.told}"
        camera = self._model.subject.world_to_camera[:1]
        turns = turn_seen(mapped.theta, camera, self._model.avatar.layout)
        beyond = self._beyond(mapped.theta, turns)
        self.tell(
            f"{len(mapped.theta)} frames of {driver.root}{left_out}{beyond and f', {beyond}'}"
        )
        self._rates["driving sequence"] = rate = driver.playback_rate
        playing: dict[str, Any] = {"driven_by": "driving sequence", "frames_per_second": rate}
        self.change(sequence=mapped.theta, sequence_frame=0, **playing)

    def listen_live(
        self, calibrate: Callable[[], None], drawn: Callable[[ViewerState], None]
    ) -> None:
        """Offer what a live performance needs; `drawn` is called after each picture."""
        self._calibrate, self._drawn_live = calibrate, drawn

    def show_live(self, frame: DrivenFrame) -> None:
        """Show a live performer's frame, unless the user has chosen something else meanwhile."""
        first = self.state.live is None
        if first and self._widgets is not None:
            self._widgets.offer_calibration(self._calibrate)
        driven_by = "live performer" if first else self.state.driven_by
        self.change(live=frame, driven_by=driven_by)

    def advance(self) -> None:
        """Show the next frame, after the last the first, where frames drive."""
        state = self.state
        if state.driven_by == "driving sequence" and state.sequence is not None:
            self.change(sequence_frame=(state.sequence_frame + 1) % len(state.sequence))
        elif state.driven_by == "dataset frame":
            self.change(frame=(state.frame + 1) % self._num_frames)

    def tell(self, text: str) -> None:
        """Put a line into the panel; without a viewer nobody reads it."""
        if self._widgets is not None:
            self._widgets.tell(text)

    def theta_shown(self) -> Float[Tensor, "H"]:
        """What drives now, on the CPU."""
        state = replace(self.state, basis_alone=None)
        return driving_signal(self._model, state, self._time_now()).theta[0].cpu()

    def _psi_shown(self) -> Float[Tensor, "K"]:
        state = replace(self.state, **_ALL_BASES)
        return self._psi_of(driving_signal(self._model, state, self._time_now()))[0].cpu()

    @torch.no_grad()
    def _psi_of(self, signal: DrivingSignal) -> Float[Tensor, "1 K"]:
        if signal.psi is not None:
            return signal.psi
        with using_threads(1):  # A picture is about to be drawn.
            return self._model.avatar.weights(signal.theta)

    def _drawn(
        self, state: ViewerState, camera: PinholeCameras, time_share: float | FilmMoment | None
    ) -> tuple[DrivingSignal, ViewerRender]:
        model, seen = self._model, self._seen and self._seen.statistics
        signal = driving_signal(model, state, time_share, seen)
        options: dict[str, Any] = {"film": self._film, "backend": model.config.rasterizer}
        options["with_depth"] = self._depth_is_wanted()
        # Films of `ns-render` are exact.
        options["to_be_seen"] = self._viewer is not None
        return signal, viewer_render(model.avatar, signal, state, camera, **options)

    def _depth_is_wanted(self) -> bool:
        """Whether nerfstudio's controls show the output or lay other things behind the avatar."""
        if self._viewer is None:
            return True
        panel = self._viewer.control_panel
        shown = [panel.output_render, *([panel.split_output_render] if panel.split else [])]
        return panel.layer_depth or "depth" in shown

    def _present(self) -> ViewerState:
        """The state, but a camera path that is previewed shows what `ns-render` will."""
        if self._viewer is not None and self._viewer.render_tab_state.preview_render:
            return ViewerState(driven_by="viewer's time", background=self.state.background)
        return self.state

    def _time_now(self) -> float | None:
        if self._viewer is None or not self._viewer.include_time:
            return None
        return float(self._viewer.control_panel.time)

    @property
    def _num_frames(self) -> int:
        return len(self._model.frame_theta)

    def _refresh(self) -> None:
        """Show the state in the controls and draw anew; does nothing without a viewer."""
        if self._widgets is not None:
            self._widgets.follow(self.state)
            moving = self.state.playing or self.state.driven_by == "live performer"
            ask_for_pictures(self._viewer, hold_training=not moving)

    def _hide_training(self) -> None:
        """Take away what steers training where there is none."""
        viewer = self._viewer
        if viewer.trainer is None or viewer.trainer.training_state == "completed":
            panel = viewer.control_panel
            steering = (panel._train_speed.gui_handle, panel._train_util.gui_handle)
            for handle in (viewer.pause_train, viewer.resume_train, *steering):
                if handle.visible:
                    handle.visible = False

    def _refine(self, report: _Report) -> None:
        """Once a picture of nerfstudio's own size was quick, draw twice as fine."""
        resolution = self._viewer.control_panel._max_res
        if self._may_refine and max(report.width_px, report.height_px) == resolution.value:
            quick = report.seconds < _QUICK_S
            self._may_refine = not quick and resolution.value == _PLAIN_PX
            if quick and resolution.value == _PLAIN_PX:
                resolution.value = 2 * _PLAIN_PX

    def _tick_forever(self) -> None:
        while True:
            time.sleep(_TICK_S)
            self.tick()


def _same(old: Any, new: Any) -> bool:
    if isinstance(old, Tensor) and isinstance(new, Tensor):
        return torch.equal(old, new)
    return type(old) is type(new) and bool(old == new)


def _in_words(error: Exception) -> str:
    known = f"{error.cause} {error.remedy}" if isinstance(error, UserError) else repr(error)
    return f"**Cannot be shown**: {known}"
