"""The driven avatar on web pages: the page itself, and what moves it."""

import contextlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection

from rgbavatar_ns.driving.live_drive import DrivenFrame, Latencies
from rgbavatar_ns.driving.local_server import LocalServer
from rgbavatar_ns.driving.messages import hello, parse_json, status_message, theta_message
from rgbavatar_ns.errors import UserError
from rgbavatar_ns.head import ThetaLayout

DEFAULT_ADDRESS = "127.0.0.1:7072"
_WAIT_S, _FAREWELL_S = 0.5, 2.0
_REMEMBERED = 500
"""Frames whose capture is remembered until a page has shown them."""


class PageOutput:
    """Sends each driven frame's theta to all pages that are open, the newest to slow ones.

    Browsers that ask for the address itself get `page`; one from the disk connects to
    `keyed_address`. A page answers with what it has shown, which makes the latency, and may ask
    for a calibration. Raises UserError as `LocalServer`.
    """

    def __init__(
        self,
        layout: ThetaLayout,
        listen: str = DEFAULT_ADDRESS,
        allow_remote: bool = False,
        page: Callable[[], bytes] | None = None,
        calibrate: Callable[[], None] = lambda: None,
    ) -> None:
        self.latencies = Latencies()
        self._hello, self._calibrate = hello(layout), calibrate
        self._changed = threading.Condition()
        self._frame: DrivenFrame | None = None
        self._message = self._status = ""
        self._captured_s: OrderedDict[int, float] = OrderedDict()
        self._closed = False
        self.pages = 0
        self._server = LocalServer(listen, allow_remote, self._talk, page)
        self.address, self.keyed_address = self._server.address, self._server.keyed_address

    def show(self, frame: DrivenFrame) -> None:
        """Send the frame to all pages."""
        message = theta_message(frame.index, frame.theta)
        with self._changed:
            self._frame, self._message = frame, message
            self._captured_s[frame.index] = frame.captured_s
            while len(self._captured_s) > _REMEMBERED:
                self._captured_s.popitem(last=False)
            self._changed.notify_all()

    def tell(self, line: str) -> None:
        """Have all pages show how it goes."""
        with self._changed:
            self._status = line
            self._changed.notify_all()

    def close(self) -> None:
        """Say farewell and hang up."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self.pages == 0, _FAREWELL_S)
        self._server.close()

    def _talk(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            connection.send(self._hello)
            listener = threading.Thread(
                target=self._listen, args=(connection,), name="rgbavatar page", daemon=True
            )
            listener.start()
            with self._changed:
                self.pages += 1
            try:
                self._send(connection)
            finally:
                with self._changed:
                    self.pages -= 1
                    self._changed.notify_all()

    def _send(self, connection: ServerConnection) -> None:
        """The newest frame and status, whenever there is one that this page has not got."""
        last: DrivenFrame | None = None
        told = ""

        def is_new() -> bool:
            return self._closed or self._frame is not last or self._status != told

        while True:
            with self._changed:
                self._changed.wait_for(is_new, _WAIT_S)
                frame, message, status = self._frame, self._message, self._status
            if self._closed:
                connection.send(status_message("The performance has ended."))
                connection.close()  # In order: a page that is only cut off thinks of a loss.
                return
            if frame is not last:
                connection.send(message)
            if status != told:
                connection.send(status_message(status))
            if connection.close_code is not None:
                return
            last, told = frame, status

    def _listen(self, connection: ServerConnection) -> None:
        """What the page says: what it has shown, and wishes."""
        with contextlib.suppress(ConnectionClosed):
            for text in connection:
                try:
                    message = parse_json(text)
                except UserError:
                    continue
                index = message.get("index")
                if message["type"] == "calibrate":
                    self._calibrate()
                elif message["type"] == "shown" and isinstance(index, int):
                    with self._changed:
                        captured_s = self._captured_s.pop(index, None)
                    if captured_s is not None:
                        self.latencies.add(captured_s, time.monotonic())
