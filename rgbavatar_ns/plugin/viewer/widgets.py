"""How the avatar's panel looks in viser; it shows the panel's state and passes on what is done."""

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, get_args

from rgbavatar_ns.export.driving import ThetaNames
from rgbavatar_ns.plugin.viewer.sliders import TITLES, NumberSlider, number_sliders
from rgbavatar_ns.plugin.viewer.viewer_state import DrivenBy, PictureKind, ViewerState

if TYPE_CHECKING:
    from rgbavatar_ns.plugin.viewer.panel import ViewerPanel

_TOPMOST = -1.0
_STRONGEST = 12
_LEAST_WEIGHT = 1.0
_NO_BASIS = "none"
_Number = int | float


class Widgets:
    """The controls of one panel, made once when the viewer starts."""

    def __init__(self, gui: Any, panel: "ViewerPanel") -> None:
        self._gui, self._panel = gui, panel
        self._echoes: Counter[str] = Counter()
        self._numbers: list[tuple[NumberSlider, Any]] = []
        self._weights: list[Any] = []
        with gui.add_folder("Avatar", order=_TOPMOST):
            self._report = gui.add_markdown("")
            self._said = gui.add_markdown("", visible=False)
            tabs = gui.add_tab_group()
            with tabs.add_tab("Drive"):
                self._add_driving()
            with tabs.add_tab("Face"):
                self._add_numbers()
            with tabs.add_tab("Bases"):
                self._add_bases()
            with tabs.add_tab("Look"):
                self._add_looks()

    def follow(self, wishes: ViewerState) -> None:
        """Bring the controls to the panel's state."""
        self._put(self._driven_by, wishes.driven_by)
        self._put(self._frame, wishes.frame)
        if self._sequence_frame is not None:
            self._put(self._sequence_frame, wishes.sequence_frame)
        if wishes.driven_by == "by hand" and wishes.theta_by_hand is not None:
            for slider, handle in self._numbers:
                shown = float(wishes.theta_by_hand[slider.place]) * slider.shown_per_unit
                self._put(handle, min(max(shown, slider.low), slider.high))
        self._put(self._by_hand, wishes.psi_by_hand is not None)
        if wishes.psi_by_hand is not None:
            for handle, weight in zip(self._weights, wishes.psi_by_hand.tolist()):
                self._put(handle, weight)
        alone = wishes.basis_alone
        self._put(self._alone, _NO_BASIS if alone is None else str(alone))

    def offer_sequence(self, num_frames: int) -> None:
        """Make a slider for a driver's frames, in place of the last driver's."""
        if self._sequence_frame is not None:
            self._sequence_frame.remove()
        with self._driver_folder:
            self._sequence_frame = self._slider(
                "Driver's frame",
                (0, max(1, num_frames - 1), 1),
                0,
                lambda value: self._panel.change(sequence_frame=int(value)),
            )

    def report(self, text: str) -> None:
        """Say how the last picture was drawn."""
        self._report.content = text

    def tell(self, text: str) -> None:
        """Say something to the user until the next time."""
        self._said.content = text
        self._said.visible = bool(text)

    def _add_driving(self) -> None:
        gui, panel = self._gui, self._panel
        last = max(1, panel.stage.num_frames - 1)
        self._driven_by = gui.add_dropdown(
            "Driven by",
            get_args(DrivenBy),
            hint="What chooses expression and pose; moving a slider of the face does it by hand",
        )
        self._on(self._driven_by, panel.drive_by)
        self._frame = self._slider(
            "Frame",
            (0, last, 1),
            0,
            lambda value: panel.change(frame=int(value), driven_by="dataset frame"),
        )
        play = gui.add_checkbox("Play", False, hint="Move on by itself, round and round")
        self._on(play, lambda value: setattr(panel, "playing", value))
        rate = gui.add_slider("Frames a second", 1, 60, 1, round(panel.frames_per_second))
        self._on(rate, lambda value: setattr(panel, "frames_per_second", float(value)))
        self._button("Neutral", panel.rest, "Drive by hand from the most neutral frame")
        self._button("Random expression", panel.surprise, "Within what was seen in training")
        self._sequence_frame: Any = None
        self._driver_folder = gui.add_folder("Driver", expand_by_default=False)
        with self._driver_folder:
            folder = gui.add_text("Folder", "", hint="Another person's dataset, or a run")
            relative = gui.add_dropdown(
                "Relative to",
                ("neutral", "mean", "off"),
                hint="What of the driver's is replaced by the avatar's own",
            )
            self._button(
                "Load driver",
                lambda: panel.load_driver(folder.value, relative.value),
                "Play that performance on this avatar",
            )

    def _add_numbers(self) -> None:
        avatar = self._panel.stage.avatar
        names = ThetaNames.of(avatar.layout, avatar.head.arrays)
        sliders = number_sliders(names, self._panel.stage.statistics())
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
            lambda value: self._panel.set_number(slider.place, value / slider.shown_per_unit),
        )
        self._numbers.append((slider, handle))

    def _add_bases(self) -> None:
        gui, panel = self._gui, self._panel
        count = panel.stage.avatar.config.num_bases
        self._by_hand = gui.add_checkbox(
            "Weights by hand", False, hint="Hold psi, in place of the network's answer"
        )
        self._on(self._by_hand, panel.override_weights)
        if count == 0:
            self._by_hand.disabled = True
        used = gui.add_slider("Bases used", 0, max(1, count), 1, count, disabled=count == 0)
        self._on(used, lambda value: panel.change(bases_used=int(value)))
        self._alone = gui.add_dropdown(
            "One basis alone",
            (_NO_BASIS, *map(str, range(count))),
            hint="Base and this basis at its largest weight in training, on the neutral frame",
        )
        self._on(
            self._alone,
            lambda value: panel.change(basis_alone=None if value == _NO_BASIS else int(value)),
        )
        self._slider("Exaggerated by", (0, 5, 0.1), 1.5, lambda v: panel.change(gain=float(v)))
        seen = panel.stage.statistics()
        for basis in range(count):
            reach = 1.5 * max(float(seen.psi_max[basis]), -float(seen.psi_min[basis]))
            reach = max(_LEAST_WEIGHT, reach)
            handle = self._slider(
                f"psi {basis}",
                (-reach, reach, 0.01),
                0.0,
                lambda value, basis=basis: panel.set_weight(basis, value),
            )
            self._weights.append(handle)

    def _add_looks(self) -> None:
        gui, panel = self._gui, self._panel
        picture = gui.add_dropdown(
            "Picture",
            get_args(PictureKind),
            hint="Beside the film: frame, avatar and error times 4, from the film's camera",
        )
        self._on(picture, lambda value: panel.change(picture=value))
        mesh = gui.add_checkbox("Mesh", False, hint="The head mesh that carries the Gaussians")
        self._on(mesh, lambda value: panel.change(mesh=value))
        centres = gui.add_checkbox("Gaussian centres", False, hint="Of those that can be seen")
        self._on(centres, lambda value: panel.change(centres=value))
        backdrop = gui.add_rgb("Backdrop", (255, 255, 255), hint="Colour behind the head")
        self._on(
            backdrop,
            lambda rgb: panel.change(backdrop=tuple(channel / 255 for channel in rgb)),
        )

    def _slider(
        self, label: str, limits: tuple[_Number, ...], value: _Number, done: Callable[..., Any]
    ) -> Any:
        handle = self._gui.add_slider(label, *limits, min(max(value, limits[0]), limits[1]))
        self._on(handle, done)
        return handle

    def _button(self, label: str, done: Callable[[], None], hint: str) -> None:
        self._gui.add_button(label, hint=hint).on_click(lambda _: done())

    def _on(self, handle: Any, done: Callable[[Any], None]) -> None:
        """Pass on what the user does with a control, but not the echo of what `_put` did."""

        def updated(_: Any) -> None:
            if self._echoes[handle._impl.id] > 0:
                self._echoes[handle._impl.id] -= 1
            else:
                done(handle.value)

        handle.on_update(updated)

    def _put(self, handle: Any, value: Any) -> None:
        if handle.value != value:
            self._echoes[handle._impl.id] += 1
            handle.value = value
