"""A listening socket that lives through floods."""

import contextlib
import os
import socket
import time
from typing import Any

from rgbavatar_ns.data.streams.address import StreamAddress

_MOST_CONNECTIONS = 8
"""Each may fill memory with the largest message."""
_RETRY_S = 0.02


class BoundedListener(socket.socket):
    """A listening socket that holds a bounded number of connections."""

    def __init__(self, address: StreamAddress) -> None:
        super().__init__(socket.AF_INET6 if ":" in address.host else socket.AF_INET)
        try:
            if os.name == "posix":  # Elsewhere two programs could listen at one address.
                self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.bind(address)
            self.listen()
        except BaseException:
            self.close()
            raise
        self._connections: list[socket.socket] = []
        self._kept: socket.socket | None = None

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; the oldest ones that are no client make room for it."""
        while True:
            try:
                connection, peer = super().accept()
            except OSError:
                if self.fileno() < 0:
                    raise
                time.sleep(_RETRY_S)  # The process has no file left, or the other side has gone.
                continue
            self._make_room()
            self._connections = [*self._open(), connection]
            return connection, peer

    def _make_room(self) -> None:
        for waiting in [one for one in self._open() if one is not self._kept]:
            if len(self._open()) < _MOST_CONNECTIONS:
                return
            hang_up(waiting)
            time.sleep(_RETRY_S)

    def keep(self, connection: socket.socket) -> None:
        """This is the client's: it is not hung up on to make room."""
        self._kept = connection

    def hang_up_on_all(self) -> None:
        """End all connections at once."""
        for connection in self._open():
            hang_up(connection)

    def _open(self) -> list[socket.socket]:
        return [one for one in self._connections if one.fileno() >= 0]


def hang_up(connection: socket.socket) -> None:
    """End a connection for its own threads too, also where they wait for it."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
