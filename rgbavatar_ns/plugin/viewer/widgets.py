"""How the avatar's panel looks in viser; it shows a state and passes on what the user does."""

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, get_args, runtime_checkable

from jaxtyping import Float
from torch import Tensor
from viser._messages import GuiUpdateMessage

from rgbavatar_ns.avatar.storage.statistics import TrainingStatistics
from rgbavatar_ns.plugin.viewer.sliders import (
    TITLES,
    NumberSlider,
    WeightSlider,
    digits_of,
    weight_sliders,
)
from rgbavatar_ns.plugin.viewer.viewer_state import DrivenBy, PictureKind, ViewerState

_TOPMOST = -1.0
_STRONGEST = 12
_NO_BASIS = "none"
_HIGHEST_RATE = 60
_Number = int | float


@runtime_checkable
class Actions(Protocol):
    """What controls do; the panel's methods."""

    def change(self, **values: Any) -> None: ...  # noqa: D102
    def drive_by(self, driven_by: DrivenBy) -> None: ...  # noqa: D102
    def set_theta_number(self, place: int, value: float) -> None: ...  # noqa: D102
    def play(self, on: bool) -> None: ...  # noqa: D102
    def show_neutral(self) -> None: ...  # noqa: D102
    def show_random_expression(self) -> None: ...  # noqa: D102
    def set_weight(self, basis: int, value: float) -> None: ...  # noqa: D102
    def hold_weights(self, by_hand: bool) -> None: ...  # noqa: D102
    def load_driver(self, folder: str, relative: str) -> None: ...  # noqa: D102


class Widgets:
    """The controls of one panel, made once when the viewer starts."""

    def __init__(
        self,
        gui: Any,
        actions: Actions,
        sliders: list[NumberSlider],
        statistics: TrainingStatistics,
        num_frames: int,
        frames_per_second: float,
    ) -> None:
        self._gui, self._do = gui, actions
        self._numbers: list[tuple[NumberSlider, Any]] = []
        self._weights: list[tuple[WeightSlider, Any]] = []
        with gui.add_folder("Avatar", order=_TOPMOST):
            self._report = gui.add_markdown("")
            self._said = gui.add_markdown("", visible=False)
            tabs = gui.add_tab_group()
            with tabs.add_tab("Drive"):
                self._add_driving(num_frames, frames_per_second)
            with tabs.add_tab("Face"):
                self._add_numbers(sliders)
            with tabs.add_tab("Bases"):
                self._add_bases(statistics)
            with tabs.add_tab("Look"):
                self._add_looks()

    def follow(self, state: ViewerState) -> None:
        """Bring the controls to the panel's state."""
        _put(self._driven_by, state.driven_by)
        _put(self._frame, state.frame)
        _put(self._rate, _shown_rate(state.frames_per_second))
        if self._sequence_frame is not None:
            _put(self._sequence_frame, state.sequence_frame)
        _put(self._by_hand, state.psi_by_hand is not None)
        alone = state.basis_alone
        _put(self._alone, _NO_BASIS if alone is None else str(alone + 1))

    def show_driving(self, theta: Float[Tensor, "H"], psi: Float[Tensor, "K"]) -> None:
        """Bring the sliders of face and bases to the numbers that a picture was drawn with."""
        for slider, handle in self._numbers:
            _put(handle, slider.shown(float(theta[slider.place])), slider.step)
        for (slider, handle), weight in zip(self._weights, psi.tolist()):
            _put(handle, slider.shown(weight), slider.step)

    def renew(self, sliders: list[NumberSlider], statistics: TrainingStatistics) -> None:
        """Bring ends, marks and hints of the sliders to what the avatar has seen by now."""
        of_place = {slider.place: slider for slider in sliders}
        numbers = [(of_place[old.place], handle) for old, handle in self._numbers]
        weights = zip(weight_sliders(statistics), (handle for _, handle in self._weights))
        before = [*self._numbers, *self._weights]
        self._numbers, self._weights = numbers, list(weights)
        for (old, handle), (slider, _) in zip(before, [*self._numbers, *self._weights]):
            if slider != old:
                _renew(handle, slider)

    def offer_sequence(self, num_frames: int) -> None:
        """Make a slider for a driver's frames, in place of the last driver's."""
        if self._sequence_frame is not None:
            self._sequence_frame.remove()
        ends = (0, max(1, num_frames - 1), 1)
        with self._driver_folder:
            self._sequence_frame = self._slider(
                "Driver's frame", ends, 0, lambda v: self._do.change(sequence_frame=int(v))
            )

    def offer_calibration(self, calibrate: Callable[[], None]) -> None:
        """Make the button with which a live performer's neutral face is learnt again."""
        with self._driver_folder:
            hint = "The performer's neutral face is learnt again from the next second"
            self._button("Calibrate", calibrate, hint)

    def report(self, text: str) -> None:
        """Say how the last picture was drawn."""
        self._report.content = text

    def tell(self, text: str) -> None:
        """Say something to the user until the next time."""
        self._said.content = text
        self._said.visible = bool(text)

    def _add_driving(self, num_frames: int, frames_per_second: float) -> None:
        gui, do = self._gui, self._do
        hint = "What chooses expression and pose; moving a slider of the face does it by hand"
        driven_by = gui.add_dropdown("Driven by", get_args(DrivenBy), hint=hint)
        self._driven_by = _on(driven_by, do.drive_by)
        ends = (0, max(1, num_frames - 1), 1)
        self._frame = self._slider(
            "Frame", ends, 0, lambda v: do.change(frame=int(v), driven_by="dataset frame")
        )
        hint = "Frames one after the other, round and round"
        play = gui.add_checkbox("Play", False, hint=hint)
        _on(play, do.play)
        rate = _shown_rate(frames_per_second)
        self._rate = self._slider(
            "Frames/s", (1, _HIGHEST_RATE, 1), rate, lambda v: do.change(frames_per_second=float(v))
        )
        self._button("Neutral", do.show_neutral, "Drive by hand from the most neutral frame")
        hint = "Within what was seen in training"
        self._button("Random expression", do.show_random_expression, hint)
        self._sequence_frame: Any = None
        self._driver_folder = gui.add_folder("Driver", expand_by_default=False)
        with self._driver_folder:
            folder = gui.add_text("Folder", "", hint="Another person's dataset, or a run")
            hint = "What of the driver's is replaced by the avatar's own"
            relative = gui.add_dropdown("Relative to", ("neutral", "mean", "off"), hint=hint)
            self._button(
                "Load driver",
                lambda: do.load_driver(folder.value, relative.value),
                "Play that performance on this avatar",
            )

    def _add_numbers(self, sliders: list[NumberSlider]) -> None:
        expressions = [slider for slider in sliders if slider.field == "expression"]
        for slider in expressions[:_STRONGEST]:
            self._add_number(slider)
        folders: dict[str, list[NumberSlider]] = {
            "More expressions": expressions[_STRONGEST:],
            **{title: [] for title in TITLES.values()},
        }
        for slider in sliders:
            if slider.field != "expression":
                folders.setdefault(TITLES.get(slider.field, slider.field), []).append(slider)
        for title, inside in folders.items():
            if inside:
                with self._gui.add_folder(title, expand_by_default=title == "Jaw"):
                    for slider in inside:
                        self._add_number(slider)

    def _add_number(self, slider: NumberSlider) -> None:
        handle = self._slider(
            slider.label,
            (slider.low, slider.high, slider.step),
            0.0,
            lambda value: self._do.set_theta_number(slider.place, value / slider.shown_per_unit),
            slider.hint,
            slider.marks,
        )
        self._numbers.append((slider, handle))

    def _add_bases(self, seen: TrainingStatistics) -> None:
        gui, do, count = self._gui, self._do, len(seen.psi_max)
        gui.add_markdown(
            f"The head is a base and {count} learned changes of its Gaussians. A network weighs "
            "these by expression and jaw."
        )
        hint = "Keep the weights as they stand, in place of the network's answer to each frame"
        by_hand = gui.add_checkbox("Hold weights", False, hint=hint, disabled=count == 0)
        self._by_hand = _on(by_hand, do.hold_weights)
        hint = "Only the first so many count; the others weigh nothing"
        used = gui.add_slider(
            "Bases used", 0, max(1, count), 1, count, hint=hint, disabled=count == 0
        )
        _on(used, lambda value: do.change(bases_used=int(value)))
        alone = gui.add_dropdown(
            "Show one alone",
            (_NO_BASIS, *(str(1 + basis) for basis in range(count))),
            hint="On the neutral frame, at its largest weight in training times Exaggerate",
        )
        self._alone = _on(
            alone,
            lambda value: do.change(basis_alone=None if value == _NO_BASIS else int(value) - 1),
        )
        hint = "Times its largest weight in training, where a basis is shown alone"
        self._slider("Exaggerate", (0, 5, 0.1), 1.5, lambda v: do.change(gain=float(v)), hint)
        for basis, slider in enumerate(weight_sliders(seen)):
            label, ends = f"Basis {basis + 1}", (slider.low, slider.high, slider.step)
            set_this = partial(do.set_weight, basis)
            handle = self._slider(label, ends, 0.0, set_this, slider.hint, slider.marks)
            self._weights.append((slider, handle))

    def _add_looks(self) -> None:
        gui, do = self._gui, self._do
        hint = "Beside the film: frame, avatar and error times 4, from the film's camera"
        picture = gui.add_dropdown("Picture", get_args(PictureKind), hint=hint)
        _on(picture, lambda value: do.change(picture=value))
        mesh = gui.add_checkbox("Mesh", False, hint="The head mesh that carries the Gaussians")
        _on(mesh, lambda value: do.change(mesh=value))
        centres = gui.add_checkbox("Gaussian centres", False, hint="Of those that can be seen")
        _on(centres, lambda value: do.change(centres=value))
        background = gui.add_rgb("Background", (255, 255, 255), hint="Colour behind the head")
        _on(background, lambda rgb: do.change(background=tuple(part / 255 for part in rgb)))

    def _slider(
        self,
        label: str,
        limits: tuple[_Number, ...],
        value: _Number,
        done: Callable[..., Any],
        hint: str | None = None,
        marks: tuple[float, float] | None = None,
    ) -> Any:
        value = min(max(value, limits[0]), limits[1])
        ends = None if marks is None else _without_doubles(marks)
        return _on(self._gui.add_slider(label, *limits, value, marks=ends, hint=hint), done)

    def _button(self, label: str, done: Callable[[], None], hint: str) -> None:
        self._gui.add_button(label, hint=hint).on_click(lambda _: done())


def _shown_rate(frames_per_second: float) -> int:
    return min(max(round(frames_per_second), 1), _HIGHEST_RATE)


def _on(handle: Any, done: Callable[[Any], None]) -> Any:
    """Pass on what a user does with a control; what `_put` does brings no client."""
    handle.on_update(lambda event: None if event.client is None else done(handle.value))
    return handle


def _renew(handle: Any, slider: NumberSlider | WeightSlider) -> None:
    """Let a control be another slider; its value stays. viser's page can do that, its API not."""
    updates = {
        "min": slider.low,
        "max": slider.high,
        "step": slider.step,
        "precision": digits_of(slider.step),
        "marks": tuple({"value": mark} for mark in _without_doubles(slider.marks)),
        "hint": slider.hint,
    }
    inside = handle._impl
    inside.gui_api._websock_interface.queue_message(GuiUpdateMessage(inside.id, updates))


def _without_doubles(marks: tuple[float, float]) -> tuple[float, ...]:
    return tuple(sorted(set(marks)))


def _put(handle: Any, value: Any, step: float = 0.0) -> None:
    """Set a control that stands elsewhere, by more than half a step where it has steps."""
    if abs(handle.value - value) > step / 2 if step else handle.value != value:
        handle.value = value
