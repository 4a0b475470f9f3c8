"""The sending side of a socket: what a tracker in another process uses."""

import dataclasses
import secrets
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType

from websockets.exceptions import ConnectionClosed, ConnectionClosedOK, WebSocketException
from websockets.sync.client import ClientConnection, connect

from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.streams import message_format
from rgbavatar_ns.data.streams.address import DEFAULT_ADDRESS, StreamAddress
from rgbavatar_ns.data.streams.backoff import Backoff
from rgbavatar_ns.data.streams.protocol import StreamSubject
from rgbavatar_ns.errors import UserError

_ANSWER_S = 10.0
_KEPT_BYTES = 16 << 20
"""Newest messages that are kept to be sent again: more than the system's buffers hold."""


class StreamClient:
    """Sends tracked frames to an `ns-train rgbavatar-online` whose source.kind is socket::

        head = HeadModel.embedded()
        subject = StreamSubject(head.arrays, identity, head.layout, width, height)
        with StreamClient(subject) as client:
            for index, (image_rgba, theta) in enumerate(my_tracker()):
                client.send(TrackedFrame(index, theta, camera, image_rgba))

    Leaving the `with` block ends the stream; an exception in it does not, and another client may
    go on. A lost connection is made again for `patience_s`, with growing pauses, and the frames
    that had been on their way are sent once more. Raises UserError where nobody listens, or the
    client is refused.
    """

    def __init__(
        self,
        subject: StreamSubject,
        address: str = DEFAULT_ADDRESS,
        patience_s: float = 60.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        session = subject.session or secrets.token_hex(8)
        named = dataclasses.replace(subject, session=session, client=secrets.token_hex(8))
        self._greeting = message_format.subject_message(named)
        self._address = StreamAddress.parse(address)
        self._patience_s, self._clock, self._sleep = patience_s, clock, sleep
        self._newest: deque[bytes] = deque()
        self._newest_bytes = self._sent = 0
        self._connection = self._connect()

    def send(self, frame: TrackedFrame, png: bytes | None = None) -> None:
        """Send one frame; `png` is its image where that is encoded already."""
        self._send(message_format.frame_message(frame, png))

    def end(self) -> None:
        """Say that no frame follows, and wait until all frames have been taken."""
        self._send(message_format.end_message())
        while True:
            try:
                self._connection.recv()
            except ConnectionClosedOK:
                return
            except ConnectionClosed:
                self._connection = self._connect()

    def close(self) -> None:
        """Hang up."""
        self._connection.close()

    def __enter__(self) -> "StreamClient":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error is None:
                self.end()
        finally:
            self.close()

    def _send(self, message: bytes) -> None:
        if len(message) > message_format.LARGEST_MESSAGE:
            raise UserError(
                f"A frame of {len(message)} bytes is too large for a stream.",
                f"Send smaller images: a message has at most {message_format.LARGEST_MESSAGE}.",
            )
        self._newest.append(message)
        self._sent += 1
        self._newest_bytes += len(message)
        while self._newest_bytes > _KEPT_BYTES and len(self._newest) > 1:
            self._newest_bytes -= len(self._newest.popleft())
        try:
            self._connection.send(message)
        except ConnectionClosed:
            self._connection = self._connect()

    def _connect(self) -> ClientConnection:
        """Connect and send what the other side has not had, trying again for a while."""
        deadline, backoff = self._clock() + self._patience_s, Backoff()
        while True:
            try:
                return self._try_to_connect()
            except (OSError, WebSocketException) as error:
                pause = backoff.pause_s()
                if self._clock() + pause > deadline:
                    raise UserError(
                        f"Nobody takes frames at {self._address}: {error}.",
                        "Start `ns-train rgbavatar-online --pipeline.datamanager.source.kind "
                        "socket` first, with the same address.",
                    ) from None
                self._sleep(pause)

    def _try_to_connect(self) -> ClientConnection:
        # As a context, for else newer versions warn; it is closed by `close`.
        connection = connect(
            f"ws://{self._address}", compression=None, proxy=None, open_timeout=_ANSWER_S
        ).__enter__()
        try:
            connection.send(self._greeting)
            received = message_format.parse_answer(connection.recv(timeout=_ANSWER_S))
            if not self._newest:  # Another client may have used the session before.
                self._sent = received
            missing = max(0, self._sent - received)
            for message in list(self._newest)[max(0, len(self._newest) - missing) :]:
                connection.send(message)
        except BaseException:
            connection.close()
            raise
        return connection
