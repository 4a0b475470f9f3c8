"""UDP packets as they come: the newest few, with the time at which they came."""

import contextlib
import socket
import threading
import time
from collections import deque

from rgbavatar_ns.data.streams.address import StreamAddress
from rgbavatar_ns.errors import UserError

_LONGEST = 1 << 16
_LOOK_S = 0.2
_RECEIVE_BUFFER = 1 << 20


class Datagrams:
    """Receives in a thread of its own and keeps the newest packets, at most `waiting`.

    Raises UserError where the address is none, is taken, or other machines can reach it unasked.
    """

    def __init__(self, listen: str, allow_remote: bool, waiting: int) -> None:
        address = StreamAddress.parse(listen)
        if not address.is_local and not allow_remote:
            raise UserError(
                f"Other machines could send to {listen}.",
                "Listen on this machine alone (127.0.0.1), or add --allow-remote: a phone needs "
                "it, and whoever reaches the port can move the avatar.",
            )
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind(tuple(address))
        except OSError as error:
            self._socket.close()
            raise UserError(
                f"Nothing can be received at {address}: {error.strerror}.",
                "Choose another --listen address, or end the program that uses this one.",
            ) from None
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self._socket.settimeout(_LOOK_S)
        self.address = str(StreamAddress(*self._socket.getsockname()[:2]))
        self._packets: deque[tuple[float, bytes]] = deque(maxlen=waiting)
        self._dropped = 0
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._receive, name="rgbavatar udp", daemon=True)
        self._thread.start()

    def take(self, timeout_s: float) -> list[tuple[float, bytes]]:
        """What has come since the last call, oldest first: time.monotonic() and content."""
        with self._changed:
            self._changed.wait_for(lambda: self._packets or self._closed, timeout_s)
            taken = list(self._packets)
            self._packets.clear()
        return taken

    def dropped(self) -> int:
        """How many packets gave way to newer ones since the last call."""
        with self._changed:
            dropped, self._dropped = self._dropped, 0
        return dropped

    def close(self) -> None:
        """Stop receiving."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout=2 * _LOOK_S)
        self._socket.close()

    def _receive(self) -> None:
        while not self._closed:
            try:
                packet = self._socket.recv(_LONGEST)
            except TimeoutError:
                continue
            except OSError:  # A sender that has gone is told on some systems; or we are closing.
                if self._closed or self._socket.fileno() < 0:
                    return
                continue
            with self._changed:
                self._dropped += len(self._packets) == self._packets.maxlen
                self._packets.append((time.monotonic(), packet))
                self._changed.notify()
