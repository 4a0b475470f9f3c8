"""Frames that another process sends over a WebSocket."""

import contextlib
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Literal

import torch
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

from rgbavatar_ns.data.streams import message_format
from rgbavatar_ns.data.streams.address import DEFAULT_ADDRESS, StreamAddress
from rgbavatar_ns.data.streams.listener import BoundedListener, hang_up
from rgbavatar_ns.data.streams.protocol import StreamedFrame, StreamSubject
from rgbavatar_ns.errors import UserError

_MOST_WAITING = 16
"""Frames that wait to be taken; a client that sends more is made to wait."""
_MOST_CONNECTIONS = 8
"""That are no client yet; and clients, of which all but one are about to end."""
_OPEN_S, _CLOSE_S = 3.0, 1.0
"""For WebSocket's own greetings and farewells."""
_LONGEST_TOLD = 400
# Port scanners and browsers are no news to the user.
_log = logging.getLogger(f"{__name__}.websockets")
_log.setLevel(logging.CRITICAL)


class SocketStream:
    """Listens for one client at a time, which sends messages as `message_format` describes them.

    While a client is connected a second one is refused, unless the first has sent no whole frame
    for `silence_s`, or it is the first one again, whose connection was lost unnoticed here: nobody
    else knows its `StreamSubject.client`. One that hangs up may come back, another may take its
    place, with the same head and image size. What is no message of a stream is counted as
    "unreadable", and told once a client. Web pages are refused. Of connections that are no client
    yet, the oldest makes room where there are too many.

    Args:
        listen: HOST:PORT (port 0: any that is free, see `address`).
        allow_remote: whether other machines may reach it: nothing is encrypted or signed.
        tell: called, from a thread, with what a user should read at once.
        silence_s: also how long a client may take to send its subject.
        grace_s: how long a second client waits before it is refused: what the first has sent
            before it hung up may still have to be read.

    Raises UserError where the address is none, is taken, or other machines can reach it unasked.
    """

    keeps_frames = False

    def __init__(
        self,
        listen: str = DEFAULT_ADDRESS,
        allow_remote: bool = False,
        tell: Callable[[str], None] = lambda line: None,
        clock: Callable[[], float] = time.monotonic,
        silence_s: float = 10.0,
        grace_s: float = 2.0,
    ) -> None:
        self._tell, self._clock = tell, clock
        self._silence_s, self._grace_s = silence_s, grace_s
        self._counts: Counter[str] = Counter()
        self._subject: StreamSubject | None = None
        self._last_identity = torch.zeros(0)  # of whom connected last
        self._client: ServerConnection | None = None
        self._named = ""  # by `StreamSubject.client`, who connected last
        self._session: str | None = None
        self._received = 0  # messages of the session
        self._listening_since_s: float | None = None
        self._frames: deque[StreamedFrame] = deque()
        self._end_seen = self._closed = False
        self._changed = threading.Condition()
        self._one_greeting = threading.Lock()  # A head takes memory while it is looked at.
        wanted = StreamAddress.parse(listen)
        if not wanted.is_local and not allow_remote:
            raise UserError(
                f"Other machines could send frames to {listen}.",
                f"Listen at {DEFAULT_ADDRESS}, or allow remote clients on purpose.",
            )
        self._server = self._listen(wanted)
        self.address = str(StreamAddress(*self._server.socket.getsockname()[:2]))
        # The threads of clients inherit that this one keeps no program alive.
        threading.Thread(
            target=self._server.serve_forever, name="rgbavatar socket", daemon=True
        ).start()

    @property
    def counts(self) -> Counter[str]:
        """What went wrong, by name."""
        with self._changed:
            return self._counts.copy()

    @property
    def ended(self) -> bool:
        """Whether a client has said that no frame follows, and all frames have been given."""
        return self._closed or (self._end_seen and not self._frames)

    def subject(self, timeout_s: float) -> StreamSubject | None:
        """The first client's subject."""
        with self._changed:
            self._changed.wait_for(lambda: self._subject is not None or self._closed, timeout_s)
            return self._subject

    def next(self, timeout_s: float) -> StreamedFrame | None:
        """The next frame."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self.ended, timeout_s)
            if self._closed or not self._frames:
                return None
            self._changed.notify_all()
            return self._frames.popleft()

    def close(self) -> None:
        """Hang up and stop listening."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        # Who does not read would be waited for without end by a farewell that WebSocket demands.
        self._listener.hang_up_on_all()
        self._server.shutdown()

    def _listen(self, address: StreamAddress) -> Server:
        try:
            self._listener = BoundedListener(address, _MOST_CONNECTIONS, _MOST_CONNECTIONS)
        except OSError as error:
            raise UserError(
                f"Frames cannot be listened for at {address}: {error.strerror}.",
                "Choose another address, or end the program that uses this one.",
            ) from None
        return serve(
            self._serve_client,
            sock=self._listener,
            origins=[None],  # Only browsers name one.
            compression=None,
            open_timeout=_OPEN_S,
            close_timeout=_CLOSE_S,
            ping_interval=None,
            max_size=message_format.LARGEST_MESSAGE,
            max_queue=1,
            logger=_log,
        )

    def _serve_client(self, connection: ServerConnection) -> None:
        """Answer one client, in a thread of its own, until it has gone."""
        with contextlib.suppress(ConnectionClosed):
            try:
                try:
                    greeting = connection.recv(timeout=self._silence_s)
                except TimeoutError:
                    raise UserError("No subject has come in time.", "Send it first.") from None
                with self._one_greeting:
                    subject = message_format.parse_subject(greeting)
                    del greeting
                self._admit(connection, subject)
            except UserError as error:
                with self._changed:
                    self._counts["refused clients"] += 1
                connection.send(f"{message_format.REFUSED} {_printable(error)}")
                return
            try:
                connection.send(f"{message_format.ACCEPTED} {self._received}")
                self._receive(connection, subject)
            finally:
                self._release(connection)

    def _admit(self, connection: ServerConnection, subject: StreamSubject) -> None:
        """Make this the client; raises UserError if there is another, or its subject is."""
        with self._changed:
            # The session does not tell: two programs may be given one name, and both live.
            returned = subject.client != "" and subject.client == self._named
            if not (returned or self._is_silent()):
                self._changed.wait_for(lambda: self._client is None or self._closed, self._grace_s)
            before, measured_anew = self._client, False
            if self._closed or (before is not None and not (returned or self._is_silent())):
                raise UserError("Another client is connected.", "End it first, or wait.")
            if self._subject is not None:
                _check_same(subject, self._subject)
                measured_anew = not subject.is_shaped_as(self._last_identity)
                self._counts["reconnects"] += 1
            self._client, self._listening_since_s = connection, self._clock()
            self._listener.keep(connection.socket)
            if subject.session == "" or subject.session != self._session:
                self._session, self._received = subject.session, 0
            self._subject = self._subject or subject
            self._last_identity, self._named = subject.identity, subject.client
            self._changed.notify_all()
        if before is not None:
            hang_up(before.socket)
        if measured_anew:
            self._tell(
                f"The client at {self.address} brings another shape of the head than was there "
                "before (another person, or measured anew): the first one's stays."
            )

    def _is_silent(self) -> bool:
        since_s = self._listening_since_s
        return since_s is not None and self._clock() - since_s >= self._silence_s

    def _receive(self, connection: ServerConnection, subject: StreamSubject) -> None:
        """Take this client's messages until it ends, or another has taken its place."""
        told = False
        while not self._end_seen:
            message, fault = connection.recv(), None
            try:
                parsed = message_format.parse_message(message, subject, self._clock())
            except UserError as error:
                parsed, fault = "unreadable", _printable(error)
            if not self._take(connection, parsed):
                return
            if fault and not told:
                self._tell(f"A message from {self.address} is left out: {fault}")
                told = True

    def _take(
        self, connection: ServerConnection, parsed: StreamedFrame | Literal["end", "unreadable"]
    ) -> bool:
        """Count a message and queue its frame; False if this is the client no more."""

        def gone() -> bool:
            return self._closed or self._client is not connection

        with self._changed:
            since_s = self._listening_since_s
            if not gone():
                self._listening_since_s = None
            self._changed.wait_for(lambda: gone() or len(self._frames) < _MOST_WAITING)
            if gone():
                return False
            self._listening_since_s = since_s
            self._received += 1
            if isinstance(parsed, StreamedFrame):
                self._listening_since_s = self._clock()
                self._frames.append(parsed)
            elif parsed == "end":
                self._end_seen = True
            else:
                self._counts[parsed] += 1
            self._changed.notify_all()
            return True

    def _release(self, connection: ServerConnection) -> None:
        with self._changed:
            if self._client is connection:
                self._client = self._listening_since_s = None
            if not self._end_seen and not self._closed:
                self._counts["source lost"] += 1
            self._changed.notify_all()


def _printable(error: UserError) -> str:
    """An error that may quote what a stranger sent, fit for a terminal."""
    return "".join(c if c.isprintable() else "?" for c in str(error)[:_LONGEST_TOLD])


def _check_same(subject: StreamSubject, first: StreamSubject) -> None:
    if (subject.width, subject.height) != (first.width, first.height):
        raise UserError(
            f"The stream began with images of {first.width} x {first.height} pixels, this "
            f"client's are {subject.width} x {subject.height}.",
            "Keep to one size.",
        )
    mine, other = first.arrays, subject.arrays
    if mine is not other and mine.digest() != other.digest():
        raise UserError(
            f"The stream began with the head '{mine.name}', this client's is another.",
            "Keep to one head model.",
        )
