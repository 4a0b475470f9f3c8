"""A program or a page of this machine that sends a performance over a WebSocket."""

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Iterator

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection

from rgbavatar_ns.avatar.method import AvatarMethod
from rgbavatar_ns.driving.local_server import LocalServer
from rgbavatar_ns.driving.messages import (
    SentPerformance,
    check_hello,
    error_message,
    parse_json,
    parse_performance,
)
from rgbavatar_ns.driving.source import PerformanceFrame, PerformerHead
from rgbavatar_ns.errors import UserError

DEFAULT_ADDRESS = "127.0.0.1:7071"
_MOST_TOLD = 20
"""Different faults of one sender that it is told."""


def arkit_trouble(avatar: AvatarMethod) -> UserError | None:
    """Why an avatar cannot follow ARKit's coefficients; None where it can.

    Takes seconds with FLAME, once: the first message would wait for it.
    """
    try:
        _ = avatar.arkit
    except UserError as error:
        return error
    return None


class WebSocketSource:
    """Listens for JSON messages "arkit" and "theta" (`driving.messages`); the newest wins.

    avatar_head: in whose layout "theta" comes. without_arkit: why the avatar cannot follow "arkit",
    if it cannot (`arkit_trouble`). Whoever connected last is followed. What cannot be used is
    counted, and the sender is told why ({"type": "error"}), once for each reason. Raises UserError
    as `LocalServer`.
    """

    ended = False

    def __init__(
        self,
        avatar_head: PerformerHead,
        listen: str = DEFAULT_ADDRESS,
        allow_remote: bool = False,
        without_arkit: UserError | None = None,
    ) -> None:
        self.head, self._without_arkit = avatar_head, without_arkit
        self.counts = Counter[str]()
        self._changed = threading.Condition()
        self._newest: tuple[float, SentPerformance] | None = None
        self._senders: list[ServerConnection] = []
        self._index = 0
        self._server = LocalServer(listen, allow_remote, self._talk)
        # Pages show it, also to others: without the key.
        kinds = '"arkit" or "theta"' if without_arkit is None else '"theta"'
        self.waits_for = f"messages {kinds} at ws://{self._server.address}"

    @property
    def address(self) -> str:
        """Where it listens."""
        return self._server.address

    @property
    def keyed_address(self) -> str:
        """The same for a page from the disk."""
        return self._server.keyed_address

    def next(self, timeout_s: float) -> PerformanceFrame | None:
        """The newest message."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, timeout_s)
            newest, self._newest = self._newest, None
            if newest is None:
                return None
            self._index += 1
            came_s, sent = newest
        return PerformanceFrame(
            self._index,
            came_s,
            came_s,
            theta=sent.theta,
            coefficients=sent.coefficients,
            head_rotation=sent.head_rotation,
        )

    def _talk(self, connection: ServerConnection) -> None:
        told: set[str] = set()
        with self._heard(connection), contextlib.suppress(ConnectionClosed):
            for text in connection:
                try:
                    message = parse_json(text)
                    if message["type"] == "hello":
                        check_hello(message)
                        continue
                    sent = parse_performance(message, self.head.layout)
                    if sent.coefficients is not None and (why := self._without_arkit) is not None:
                        raise UserError(f'"arkit" cannot move this avatar: {why.cause}', why.remedy)
                except UserError as error:
                    self._count("unreadable")
                    if error.cause not in told and len(told) < _MOST_TOLD:
                        told.add(error.cause)
                        connection.send(error_message(str(error)))
                    continue
                self._take(connection, sent)

    @contextlib.contextmanager
    def _heard(self, connection: ServerConnection) -> Iterator[None]:
        """The sender that came last counts, and once it has gone the one before it again."""
        with self._changed:
            self._senders.append(connection)
        try:
            yield
        finally:
            with self._changed:
                self._senders.remove(connection)

    def _take(self, connection: ServerConnection, sent: SentPerformance) -> None:
        with self._changed:
            if connection is not self._senders[-1]:
                self.counts["another sender"] += 1
                return
            self.counts["skipped"] += self._newest is not None
            self.counts["values beyond 0..1"] += sent.out_of_range
            self._newest = time.monotonic(), sent
            self._changed.notify()

    def _count(self, name: str) -> None:
        with self._changed:
            self.counts[name] += 1

    def close(self) -> None:
        """Hang up and listen no more."""
        self._server.close()
