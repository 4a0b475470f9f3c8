"""The sending side of a socket: what a tracker in another process uses."""

import dataclasses
import secrets
import socket
import time
from types import TracebackType

from rgbavatar_ns.data.native.frame import TrackedFrame
from rgbavatar_ns.data.streams import message_format as wire
from rgbavatar_ns.data.streams.address import DEFAULT_ADDRESS, StreamAddress
from rgbavatar_ns.data.streams.backoff import Backoff
from rgbavatar_ns.data.streams.protocol import StreamSubject
from rgbavatar_ns.data.streams.socket_server import ACCEPTED, REFUSED
from rgbavatar_ns.errors import UserError

_ANSWER_S = 10.0
_LONGEST_ANSWER = 4096


class StreamClient:
    """Sends tracked frames to `ns-train rgbavatar-online --pipeline.datamanager.source socket`.

        head = HeadModel.embedded()
        subject = StreamSubject(head.arrays, identity, head.layout, width, height)
        with StreamClient(subject) as client:
            for index, (image_rgba, theta) in enumerate(my_tracker()):
                client.send(TrackedFrame(index, theta, camera, image_rgba))

    Leaving the `with` block ends the stream; an exception in it does not, and another client may
    go on. Where the connection is lost it is made again, with growing pauses, and the frame is
    sent once more.

    Args:
        subject: who is filmed; its session is made up where it is empty.
        address: HOST:PORT or unix:PATH.
        patience_s: how long to try before giving up.

    Raises:
        UserError: nobody listens, or the client is refused.
    """

    def __init__(
        self,
        subject: StreamSubject,
        address: str = DEFAULT_ADDRESS,
        patience_s: float = 60.0,
    ) -> None:
        session = subject.session or secrets.token_hex(8)
        self._greeting = wire.subject_record(dataclasses.replace(subject, session=session))
        self._address = StreamAddress.parse(address)
        self._patience_s = patience_s
        self._connection = self._connect()

    def send(self, frame: TrackedFrame, png: bytes | None = None) -> None:
        """Send one frame; `png` is its image where that is encoded already."""
        self._send(wire.frame_record(frame, png))

    def end(self) -> None:
        """Say that no frame follows."""
        self._send(wire.end_record())

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

    def _send(self, data: bytes) -> None:
        while True:
            try:
                self._connection.sendall(data)
                return
            except OSError:
                self._connection.close()
                self._connection = self._connect()

    def _connect(self) -> socket.socket:
        deadline, backoff = time.monotonic() + self._patience_s, Backoff()
        while True:
            try:
                return self._try_to_connect()
            except OSError as error:
                pause = backoff.pause_s()
                if time.monotonic() + pause > deadline:
                    raise UserError(
                        f"Nobody takes frames at {self._address}: {error}.",
                        "Start `ns-train rgbavatar-online --pipeline.datamanager.source socket` "
                        "first, with the same address.",
                    ) from None
                time.sleep(pause)

    def _try_to_connect(self) -> socket.socket:
        connection = socket.socket(self._address.family, socket.SOCK_STREAM)
        try:
            connection.settimeout(_ANSWER_S)
            connection.connect(self._address.place)
            connection.sendall(self._greeting)
            answer = _line(connection)
            connection.settimeout(None)
        except BaseException:
            connection.close()
            raise
        if answer != ACCEPTED:
            connection.close()
            reason = answer.removeprefix(REFUSED).decode(errors="replace").strip()
            raise UserError(f"The stream at {self._address} refuses this client.", reason)
        return connection


def _line(connection: socket.socket) -> bytes:
    """What is sent up to the first line's end; raises OSError where it ends before."""
    answer = b""
    while not answer.endswith(b"\n") and len(answer) < _LONGEST_ANSWER:
        more = connection.recv(_LONGEST_ANSWER)
        if not more:
            raise OSError("the connection was closed without an answer")
        answer += more
    return answer
