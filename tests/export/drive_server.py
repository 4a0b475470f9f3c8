"""A small server of "rgbavatar-drive" for the tests of the page, apart from the project's own."""

import json
import queue
import threading
from contextlib import suppress
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from rgbavatar_ns.avatar import Avatar


def hello(avatar: Avatar, **changes: Any) -> dict[str, Any]:
    """The first message to a page of this avatar."""
    layout = avatar.layout.to_json()
    return {"type": "hello", "format": "rgbavatar-drive", "version": 1, "layout": layout} | changes


class DriveServer:
    """Listens on this machine; one page at a time, whose messages it keeps."""

    def __init__(self, port: int = 0) -> None:
        self.received: queue.Queue[dict[str, Any]] = queue.Queue()
        self._pages: queue.Queue[ServerConnection] = queue.Queue()
        self._server = serve(self._serve_page, "127.0.0.1", port)
        self.port: int = self._server.socket.getsockname()[1]
        self._page: ServerConnection | None = None
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def _serve_page(self, page: ServerConnection) -> None:
        self._pages.put(page)
        with suppress(ConnectionClosed):
            for text in page:
                self.received.put(json.loads(text))

    def wait_for_page(self) -> None:
        """Take the next page that connects."""
        self._page = self._pages.get(timeout=20)

    def send(self, *messages: Any) -> None:
        """Send objects as JSON and texts as they are."""
        assert self._page is not None
        for message in messages:
            self._page.send(message if isinstance(message, str) else json.dumps(message))

    def close(self) -> None:
        """Drop the page and stop listening."""
        self._server.shutdown()
        if self._page is not None:
            self._page.close()
        self._thread.join()
