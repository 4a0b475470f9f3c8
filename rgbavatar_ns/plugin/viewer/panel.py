"""The avatar's panel in nerfstudio's viewer: what its controls do, apart from how they look."""

import math
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.viewer.viewer_elements import ViewerControl
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException
from torch import Tensor

from rgbavatar_ns.data import load_dataset
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.export import dataset_folder
from rgbavatar_ns.export.driving import DrivingOptions
from rgbavatar_ns.export.scenes import driven_by
from rgbavatar_ns.kernels import PinholeCameras
from rgbavatar_ns.plugin.viewer.render import ViewerPicture, viewer_picture
from rgbavatar_ns.plugin.viewer.viewer_state import Stage, ViewerState, random_expression
from rgbavatar_ns.plugin.viewer.widgets import Widgets

# nerfstudio shows its world ten times as large in viser.
_VISER_PER_METRE = 10.0
_VISIBLE_HEIGHT_M = 0.45
_PATIENCE_S = 5.0
_TOLD_EVERY_S = 0.3

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Viewpoint:
    """Where the viewer's camera starts, in nerfstudio's world, metres."""

    eye: Point
    look_at: Point


class ViewerPanel(ViewerControl):
    """Draws what the panel's controls ask for where a camera brings no theta of its own.

    Without a viewer (`ns-render`) the camera's time chooses the frame, over black.
    """

    def __init__(self, stage: Stage, viewpoint: Viewpoint) -> None:
        self.stage = stage
        self.wishes = ViewerState(driven_by="viewer's time")
        self.playing = False
        self.frames_per_second = 25.0
        self._viewpoint = viewpoint
        self._viewer: Any = None
        self._widgets: Widgets | None = None
        self._drawn = threading.Event()
        self._next_told_s, self._told_size = 0.0, (0, 0)

    def _setup(self, viewer: Any) -> None:
        super()._setup(viewer)
        self._viewer = viewer
        self.wishes = ViewerState(backdrop=(1.0, 1.0, 1.0))
        self._widgets = Widgets(viewer.viser_server.gui, self)
        viewer.viser_server.scene.set_up_direction("+z")
        viewer.viser_server.on_client_connect(self._place_camera)
        threading.Thread(target=self._play, name="viewer playback", daemon=True).start()

    def draw(
        self, camera: PinholeCameras, time_share: float | None, backend: str = "auto"
    ) -> dict[str, Tensor]:
        """The picture for one camera (C = 1): rgb, accumulation, depth [H W C].

        What cannot be shown is told in the panel, and the plain avatar stands in its place:
        nothing here may end the viewer's thread, or training.
        """
        wishes = self._present()
        began = time.perf_counter()
        try:
            picture = viewer_picture(self.stage, wishes, camera, time_share, backend=backend)
            trouble = ""
        except IOChangeException:  # The viewer's own: the user has moved on.
            raise
        except Exception as error:
            if self._widgets is None:
                raise
            trouble = _in_words(error)
            plain = ViewerState(
                driven_by=wishes.driven_by, frame=wishes.frame, backdrop=wishes.backdrop
            )
            picture = viewer_picture(self.stage, plain, camera, time_share, backend=backend)
        self._tell(picture, camera, time.perf_counter() - began, trouble)
        self._drawn.set()
        return picture.outputs()

    def change(self, **values: Any) -> None:
        """Replace wishes by name and draw anew, if any is another than before."""
        if all(_same(getattr(self.wishes, name), value) for name, value in values.items()):
            return
        self.wishes = replace(self.wishes, **values)
        self.refresh()

    def refresh(self) -> None:
        """Show the state in the controls and draw anew; does nothing without a viewer."""
        if self._widgets is not None:
            self._widgets.follow(self.wishes)
            self._viewer._trigger_rerender()

    def drive_by(self, driven_by: str) -> None:
        """Choose what drives; by hand starts from what is shown."""
        if driven_by == "by hand":
            self.set_theta(self._theta_now())
        elif driven_by == "driving sequence" and self.wishes.sequence is None:
            self.tell("Load a driver first: a dataset or a run, in the folder 'Driver'.")
            self.refresh()
        else:
            self.change(driven_by=driven_by)

    def set_theta(self, theta: Float[Tensor, "H"]) -> None:
        """Drive by hand with these numbers."""
        self.change(driven_by="by hand", theta_by_hand=theta.clone())

    def set_number(self, place: int, value: float) -> None:
        """Drive by hand, with one number of theta changed from what is shown."""
        theta = self._theta_now().clone()
        theta[place] = value
        self.set_theta(theta)

    def rest(self) -> None:
        """Drive by hand: the frame with the most neutral expression."""
        self.set_theta(self.stage.statistics().theta_neutral)

    def surprise(self) -> None:
        """Drive by hand: a random expression within what was seen, on the pose shown."""
        self.set_theta(random_expression(self.stage.statistics(), self._theta_now()))

    def set_weight(self, basis: int, value: float) -> None:
        """Set one weight by hand; the others stay what the network or the hand gave them."""
        psi = self._psi_now().clone()
        psi[basis] = value
        self.change(psi_by_hand=psi, basis_alone=None)

    def override_weights(self, by_hand: bool) -> None:
        """Hold the weights where they are, or give them back to the network."""
        self.change(psi_by_hand=self._psi_now().clone() if by_hand else None)

    def load_driver(self, folder: str, relative: str) -> None:
        """Read another person's performance and play it; what is wrong is told in the panel."""
        self.tell(f"Reading {folder} ...")
        try:
            if not folder.strip():
                raise UserError("No driver is named.", "Type the folder of a dataset or run.")
            driver = load_dataset(dataset_folder(Path(folder.strip()).expanduser()))
            mapped = driven_by(
                self.stage.avatar,
                driver,
                range(len(driver)),
                self.stage.statistics(),
                self.frames_per_second,
                DrivingOptions(relative=relative),  # type: ignore[arg-type]
            )
        except Exception as error:  # In one of the viewer's threads nobody would see it.
            self.tell(_in_words(error))
            return
        if self._widgets is not None:
            self._widgets.offer_sequence(len(mapped.theta))
        unmapped = f", not known to the avatar: {', '.join(mapped.unmapped)}"
        self.tell(
            f"{len(mapped.theta)} frames of {driver.root}{unmapped if mapped.unmapped else ''}"
        )
        self.change(driven_by="driving sequence", sequence=mapped.theta, sequence_frame=0)

    def advance(self) -> bool:
        """Show the next frame, after the last the first; False where nothing can be played."""
        wishes = self.wishes
        if wishes.driven_by == "driving sequence" and wishes.sequence is not None:
            self.change(sequence_frame=(wishes.sequence_frame + 1) % len(wishes.sequence))
        elif wishes.driven_by == "dataset frame" and self.stage.num_frames > 1:
            self.change(frame=(wishes.frame + 1) % self.stage.num_frames)
        else:
            return False
        return True

    def tell(self, text: str) -> None:
        """Put a line into the panel; without a viewer nobody reads it."""
        if self._widgets is not None:
            self._widgets.tell(text)

    def _present(self) -> ViewerState:
        """The wishes, but a camera path that is previewed shows what `ns-render` will."""
        if self._viewer is not None and self._viewer.render_tab_state.preview_render:
            return ViewerState(driven_by="viewer's time", backdrop=self.wishes.backdrop)
        return self.wishes

    def _theta_now(self) -> Float[Tensor, "H"]:
        plain = replace(self.wishes, basis_alone=None)
        return self.stage.shown(plain, self._time_now()).theta[0].cpu()

    def _psi_now(self) -> Float[Tensor, "K"]:
        plain = replace(self.wishes, basis_alone=None, bases_used=None)
        shown = self.stage.shown(plain, self._time_now())
        with torch.no_grad():
            psi = self.stage.avatar.weights(shown.theta) if shown.psi is None else shown.psi
        return psi[0].cpu()

    def _time_now(self) -> float | None:
        if self._viewer is None or not self._viewer.include_time:
            return None
        return float(self._viewer.control_panel.time)

    def _tell(
        self, picture: ViewerPicture, camera: PinholeCameras, seconds: float, trouble: str
    ) -> None:
        now, size = time.monotonic(), (camera.width, camera.height)
        known = now < self._next_told_s and size == self._told_size and not trouble
        if self._widgets is None or known:
            return
        self._next_told_s, self._told_size = now + _TOLD_EVERY_S, size
        lines = [
            f"{camera.width} x {camera.height} in {1e3 * seconds:.0f} ms: "
            f"{1 / max(seconds, 1e-6):.0f} frames/s"
        ]
        if picture.psnr is not None:
            lines.append(f"PSNR of this frame {picture.psnr:.2f} dB")
        self._widgets.report("  \n".join(lines))
        if trouble:
            self._widgets.tell(trouble)

    def _place_camera(self, client: Any) -> None:
        eye, look_at = self._viewpoint.eye, self._viewpoint.look_at
        distance = math.dist(eye, look_at)
        with client.atomic():
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position = tuple(_VISER_PER_METRE * x for x in eye)
            client.camera.look_at = tuple(_VISER_PER_METRE * x for x in look_at)
            client.camera.fov = 2 * math.atan2(_VISIBLE_HEIGHT_M / 2, distance)

    def _play(self) -> None:
        """Move on at the wished rate, but not before the last picture has been drawn."""
        due = time.monotonic()
        while True:
            due = max(due + 1 / max(self.frames_per_second, 1e-3), time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))
            if self.playing:
                self._drawn.clear()
                if self.advance():
                    self._drawn.wait(_PATIENCE_S)


def _same(old: Any, new: Any) -> bool:
    if isinstance(old, Tensor) and isinstance(new, Tensor):
        return torch.equal(old, new)
    return type(old) is type(new) and bool(old == new)


def _in_words(error: Exception) -> str:
    known = f"{error.cause} {error.remedy}" if isinstance(error, UserError) else repr(error)
    return f"**Cannot be shown**: {known}"
