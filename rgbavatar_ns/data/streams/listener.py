"""A listening socket that lives through floods."""

import contextlib
import os
import socket
import threading
import time
from typing import Any

from rgbavatar_ns.data.streams.address import StreamAddress

_RETRY_S = 0.02


class BoundedListener(socket.socket):
    """A listening socket that holds a bounded number of connections.

    Args:
        address: where it listens.
        most_waiting: connections of which nothing is known yet; each may fill memory with the
            largest message, and the oldest makes room for a new one.
        most_kept: connections that are kept (`keep`) at a time.
    """

    def __init__(self, address: StreamAddress, most_waiting: int, most_kept: int) -> None:
        super().__init__(socket.AF_INET6 if ":" in address.host else socket.AF_INET)
        try:
            if os.name == "posix":  # Elsewhere two programs could listen at one address.
                self.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self.bind(address)
            self.listen()
        except BaseException:
            self.close()
            raise
        self._most_waiting, self._most_kept = most_waiting, most_kept
        self._keeping = threading.Lock()
        self._waiting: list[socket.socket] = []
        self._kept: list[socket.socket] = []

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; the oldest that is not kept makes room for it."""
        while True:
            try:
                connection, peer = super().accept()
            except OSError:
                if self.fileno() < 0:
                    raise
                time.sleep(_RETRY_S)  # The process has no file left, or the other side has gone.
                continue
            self._make_room()
            with self._keeping:
                self._waiting.append(connection)
            return connection, peer

    def _make_room(self) -> None:
        with self._keeping:
            waiting = _open(self._waiting)
            surplus = max(0, len(waiting) + 1 - self._most_waiting)
            self._waiting = waiting[surplus:]
        for oldest in waiting[:surplus]:
            hang_up(oldest)
            time.sleep(_RETRY_S)

    def keep(self, connection: socket.socket) -> bool:
        """From now on this is not hung up on to make room; False where as many are kept as may."""
        with self._keeping:
            self._kept = _open(self._kept)
            if len(self._kept) >= self._most_kept:
                return False
            self._kept.append(connection)
            self._waiting = [one for one in self._waiting if one is not connection]
        return True

    def hang_up_on_all(self) -> None:
        """End all connections at once."""
        with self._keeping:
            connections = _open(self._waiting + self._kept)
        for connection in connections:
            hang_up(connection)


def _open(connections: list[socket.socket]) -> list[socket.socket]:
    return [one for one in connections if one.fileno() >= 0]


def hang_up(connection: socket.socket) -> None:
    """End a connection for its own threads too, also where they wait for it."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
