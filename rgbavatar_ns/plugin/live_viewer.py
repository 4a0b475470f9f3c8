"""nerfstudio's viewer of a run, with the avatar driven live."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import nerfstudio.viewer.viewer
from nerfstudio.utils import writer
from nerfstudio.utils.eval_utils import eval_setup

from rgbavatar_ns.avatar.storage.checkpoint_file import CONFIG_NAME, newest_run
from rgbavatar_ns.driving.live_drive import DrivenFrame, Latencies
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.plugin.pipeline import RGBAvatarPipeline
from rgbavatar_ns.plugin.viewer.viewer_state import ViewerState


class ViewerOutput:
    """Serves the viewer of a run and shows each driven frame in its browsers.

    The panel's other ways to drive stay: "live performer" gives it back. A picture counts once it
    has been drawn for a browser. Raises UserError for what is no run of ns-train.
    """

    def __init__(self, run: Path, calibrate: Callable[[], None]) -> None:
        config_path = (newest_run(run) if run.is_dir() else run) / CONFIG_NAME
        if not config_path.is_file():
            raise UserError(
                f"{run} is no run of ns-train, which nerfstudio's viewer needs.",
                "Name the run's folder, or use --show page.",
            )
        config, pipeline, _, step = eval_setup(config_path, test_mode="test")
        assert isinstance(pipeline, RGBAvatarPipeline)
        self.latencies = Latencies()
        self._panel = pipeline.viewer_panel
        self._panel.listen_live(calibrate, self._drawn)
        folder = config.get_base_dir()
        viewer = nerfstudio.viewer.viewer.Viewer(
            replace(config.viewer, make_share_url=False),
            log_filename=folder / config.viewer.relative_log_filename,
            datapath=pipeline.datamanager.get_datapath(),
            pipeline=pipeline,
            train_lock=threading.Lock(),
        )
        self.address = f"http://{config.viewer.websocket_host}:{viewer.viser_server.get_port()}"
        # The viewer's threads write their rates into it.
        config.logging.local_writer.enable = False
        writer.setup_local_writer(config.logging, max_iter=config.max_num_iterations)
        viewer.init_scene(
            train_dataset=pipeline.datamanager.train_dataset,
            train_state="completed",
            eval_dataset=pipeline.datamanager.eval_dataset,
        )
        viewer.update_scene(step=step)
        self._viewer = viewer
        self._last_drawn: DrivenFrame | None = None

    def show(self, frame: DrivenFrame) -> None:
        """Let the browsers draw it."""
        self._panel.show_live(frame)

    def tell(self, line: str) -> None:
        """Say it in the panel."""
        self._panel.tell(line)

    def close(self) -> None:
        """End the viewer."""
        self._viewer.viser_server.stop()

    def _drawn(self, state: ViewerState) -> None:
        live = state.live
        if live is not None and live is not self._last_drawn:
            self._last_drawn = live
            self.latencies.add(live.captured_s, time.monotonic())
