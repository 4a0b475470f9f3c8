"""A WebSocket server for programs and pages of this machine."""

import logging
import re
import threading
from collections.abc import Callable
from http import HTTPStatus

from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Origin

from rgbavatar_ns.data.streams.address import StreamAddress
from rgbavatar_ns.data.streams.listener import BoundedListener
from rgbavatar_ns.driving.messages import LARGEST_MESSAGE
from rgbavatar_ns.errors import UserError

LOCAL_ORIGINS = (
    None,
    Origin("null"),
    re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"),
)
"""Programs name no origin, a page from the disk "null"; of the web only pages of this machine."""
_LOCAL_HOST = re.compile(r"(localhost|127(\.\d+){3}|\[::1\])(:\d+)?", re.IGNORECASE)
_OPEN_S, _CLOSE_S, _PING_S = 3.0, 1.0, 10.0
# Port scanners and browsers are no news to the user.
_log = logging.getLogger(f"{__name__}.websockets")
_log.setLevel(logging.CRITICAL)


class LocalServer:
    """Listens and runs `talk` for each connection in a thread of its own.

    Args:
        listen: HOST:PORT (port 0: any that is free, see `address`).
        allow_remote: whether other machines may reach it; nothing is encrypted.
        talk: a conversation, until it returns or the connection is closed.
        page: what a browser gets that asks for the address itself; None refuses it.
        origins: of web pages that may connect beside those of this machine.

    Raises UserError where the address is none, is taken, or other machines can reach it unasked.
    """

    def __init__(
        self,
        listen: str,
        allow_remote: bool,
        talk: Callable[[ServerConnection], None],
        page: Callable[[], bytes] | None = None,
        origins: tuple[str, ...] = (),
    ) -> None:
        address = StreamAddress.parse(listen)
        if not address.is_local and not allow_remote:
            raise UserError(
                f"Other machines could reach {listen}.",
                "Listen on this machine alone (127.0.0.1), or add --allow-remote.",
            )
        try:
            self._listener = BoundedListener(address)
        except OSError as error:
            raise UserError(
                f"Nothing can be served at {address}: {error.strerror}.",
                "Choose another address, or end the program that uses this one.",
            ) from None
        self._page, self._is_local = page, address.is_local
        self._server = serve(
            talk,
            sock=self._listener,
            origins=[*LOCAL_ORIGINS, *map(Origin, origins)],
            process_request=self._answer,
            compression=None,
            open_timeout=_OPEN_S,
            close_timeout=_CLOSE_S,
            ping_interval=_PING_S,
            max_size=LARGEST_MESSAGE,
            logger=_log,
        )
        self.address = str(StreamAddress(*self._server.socket.getsockname()[:2]))
        threading.Thread(
            target=self._server.serve_forever, name="rgbavatar pages", daemon=True
        ).start()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page for a browser; a WebSocket goes on.

        Who asks for another name was sent here by it: a web site's, that has been pointed at this
        machine, would count as this page's own.
        """
        if self._is_local and not _LOCAL_HOST.fullmatch(request.headers.get("Host", "localhost")):
            return connection.respond(HTTPStatus.MISDIRECTED_REQUEST, "Ask for 127.0.0.1.\n")
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None
        if self._page is None or request.path.split("?")[0] != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "Nothing is here.\n")
        content = self._page()
        headers = Headers(
            {
                "Content-Type": "text/html; charset=utf-8",
                "Content-Length": str(len(content)),
                "Cache-Control": "no-store",
                "Connection": "close",
            }
        )
        return Response(HTTPStatus.OK, "OK", headers, content)

    def close(self) -> None:
        """Hang up on all and stop listening."""
        self._listener.hang_up_on_all()
        self._server.shutdown()
