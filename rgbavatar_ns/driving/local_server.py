"""A WebSocket server for programs and pages of this machine."""

import ipaddress
import logging
import re
import secrets
import socket
import threading
from collections.abc import Callable
from http import HTTPStatus

from websockets.datastructures import Headers
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from rgbavatar_ns.data.streams.address import StreamAddress
from rgbavatar_ns.data.streams.listener import BoundedListener
from rgbavatar_ns.driving.messages import LARGEST_MESSAGE
from rgbavatar_ns.errors import UserError

_LOCAL_NAME = r"(localhost|127(\.\d+){3}|\[::1\])(:\d+)?"
_LOCAL_HOST = re.compile(_LOCAL_NAME, re.IGNORECASE)
_LOCAL_ORIGIN = re.compile(f"https?://{_LOCAL_NAME}", re.IGNORECASE)
_OPEN_S, _CLOSE_S, _PING_S = 3.0, 1.0, 10.0
_MOST_WAITING, _MOST_TALKS = 32, 64
"""Connections that fetch the page or have said nothing yet, and conversations, at a time."""
# Port scanners and browsers are no news to the user.
_log = logging.getLogger(f"{__name__}.websockets")
_log.setLevel(logging.CRITICAL)


class LocalServer:
    """Listens and runs `talk` for each connection in a thread of its own.

    At most 64 converse at a time; others are refused. Programs are welcome, and so are pages of
    this machine and this server's own. A page from the disk has the origin "null", but so has any
    web site's sandboxed frame: it shows that it is the user's by the key in the address
    (`keyed_address`), which is another each time.

    Args:
        listen: HOST:PORT (port 0: any that is free, see `address`).
        allow_remote: whether other machines may reach it; nothing is encrypted.
        talk: a conversation, until it returns or the connection is closed.
        page: what a browser gets that asks for the address itself; None refuses it.

    Raises UserError where the address is none, is taken, or other machines can reach it unasked.
    """

    def __init__(
        self,
        listen: str,
        allow_remote: bool,
        talk: Callable[[ServerConnection], None],
        page: Callable[[], bytes] | None = None,
    ) -> None:
        address = StreamAddress.parse(listen)
        if not address.is_local and not allow_remote:
            raise UserError(
                f"Other machines could reach {listen}.",
                "Listen on this machine alone (127.0.0.1), or add --allow-remote.",
            )
        try:
            self._listener = BoundedListener(address, _MOST_WAITING, _MOST_TALKS)
        except OSError as error:
            raise UserError(
                f"Nothing can be served at {address}: {error.strerror}.",
                "Choose another address, or end the program that uses this one.",
            ) from None
        self._page, self._is_local = page, address.is_local
        self._server = serve(
            talk,
            sock=self._listener,
            process_request=self._answer,
            compression=None,
            open_timeout=_OPEN_S,
            close_timeout=_CLOSE_S,
            ping_interval=_PING_S,
            max_size=LARGEST_MESSAGE,
            logger=_log,
        )
        host, port = self._server.socket.getsockname()[:2]
        number = ipaddress.ip_address(host)
        reached = _own_number(number.version) if number.is_unspecified else host
        self.address = str(StreamAddress(reached, port))
        """As a browser takes it; other machines' too, where they can reach it."""
        self._key = secrets.token_urlsafe(9)
        at_home = "127.0.0.1" if number.version == 4 else "localhost"
        own = at_home if number.is_unspecified or number.is_loopback else reached
        self.keyed_address = f"{StreamAddress(own, port)}/{self._key}"
        """The same for a page from this machine's disk."""
        threading.Thread(
            target=self._server.serve_forever, name="rgbavatar pages", daemon=True
        ).start()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page for a browser; a WebSocket of somebody who is welcome goes on.

        A browser that asks for another name was sent here by it: a web site's, that has been
        pointed at this machine, would count as this page's own.
        """
        host, origin = request.headers.get("Host", "localhost"), request.headers.get("Origin")
        is_socket = request.headers.get("Upgrade", "").lower() == "websocket"
        if is_socket and origin is None:
            return self._admit(connection)  # A program; browsers name one.
        if not (_LOCAL_HOST.fullmatch(host) or (not self._is_local and _is_this_machine(host))):
            remedy = "Ask for this machine's number, such as 127.0.0.1.\n"
            return connection.respond(HTTPStatus.MISDIRECTED_REQUEST, remedy)
        if origin is not None and is_socket:
            if self._is_welcome(origin, host, request.path):
                return self._admit(connection)
            return connection.respond(HTTPStatus.FORBIDDEN, "Not from this page.\n")
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

    def _admit(self, connection: ServerConnection) -> Response | None:
        """None: it converses, and makes room for no other one any more."""
        if self._listener.keep(connection.socket):
            return None
        remedy = f"As many are connected as may be ({_MOST_TALKS}): close one.\n"
        return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, remedy)

    def _is_welcome(self, origin: str, host: str, path: str) -> bool:
        """Whether a page of this origin that asked for this host and path may speak."""
        if origin == "null":
            return secrets.compare_digest(path.encode(), f"/{self._key}".encode())
        if _LOCAL_ORIGIN.fullmatch(origin):
            return True
        return not self._is_local and origin == f"http://{host}"

    def close(self) -> None:
        """Hang up on all and stop listening."""
        self._listener.hang_up_on_all()
        self._server.shutdown()


def _own_number(version: int) -> str:
    """The number by which others of its network know this machine; nothing is sent to find it."""
    family, elsewhere, home = (
        (socket.AF_INET, "192.0.2.1", "127.0.0.1")
        if version == 4
        else (socket.AF_INET6, "2001:db8::1", "::1")
    )
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as unsent:
            unsent.connect((elsewhere, 9))
            return unsent.getsockname()[0]
    except OSError:
        return home


def _is_this_machine(host: str) -> bool:
    """Whether a browser that asks for it can only mean this machine: a number, or its own name."""
    name = re.sub(r":\d+$", "", host).lower()
    own = socket.gethostname().lower()
    if name in {own, f"{own}.local"}:
        return True
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True
