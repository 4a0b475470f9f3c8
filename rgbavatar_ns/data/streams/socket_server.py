"""Frames that another process pushes over a socket."""

import contextlib
import dataclasses
import os
import select
import socket
import stat
import time
from collections import Counter, deque

import numpy as np

from rgbavatar_ns.data.streams import message_format as wire
from rgbavatar_ns.data.streams.address import DEFAULT_ADDRESS, StreamAddress
from rgbavatar_ns.data.streams.protocol import StreamedFrame, StreamSubject
from rgbavatar_ns.errors import UserError

ACCEPTED, REFUSED = b"OK\n", b"REFUSED "
_CHUNK_BYTES = 1 << 18
_SILENCE_S = 10.0
"""A client that has sent nothing for so long may be replaced by another."""
_MOST_GARBAGE_BYTES = 1 << 20
"""Between two whole records; a client that sends more is hung up on."""
_LONGEST_WAIT_S = 0.05
_FAREWELL_S = 0.2
_KNOCK_S, _LONGEST_KNOCK_S = 0.5, 5.0
"""How long a second client is kept waiting before it is refused: what the first has sent before
it hung up may still have to be read. The longer time is for a first that never pauses."""


@dataclasses.dataclass
class _Client:
    connection: socket.socket
    heard_s: float
    reader: wire.RecordReader = dataclasses.field(default_factory=wire.RecordReader)
    subject: StreamSubject | None = None
    garbage_noted: int = 0
    garbage_at_last_record: int = 0


class PushedStream:
    """Listens for one client at a time, which sends records as `wire` describes them.

    The client begins with its subject and is answered by a line, "OK" or "REFUSED" and the
    reason; nothing else is sent to it. While a client is connected and not silent, a second one
    is refused, after half a second in which the first may prove to have hung up. One that hangs
    up may come back, another may take its place, with the same head and image size.

    Args:
        listen: HOST:PORT (port 0: any that is free, see `address`) or unix:PATH.
        allow_remote: listen also where other machines can reach it. Whoever can, can send
            frames: nothing is encrypted or signed.

    Raises:
        UserError: the address is none, is taken, or other machines can reach it unasked.
    """

    keeps_frames = False

    def __init__(self, listen: str = DEFAULT_ADDRESS, allow_remote: bool = False) -> None:
        self.counts: Counter[str] = Counter()
        wanted = StreamAddress.parse(listen)
        if not wanted.is_local and not allow_remote:
            raise UserError(
                f"Other machines could send frames to {listen}.",
                f"Listen at {DEFAULT_ADDRESS}, or allow remote clients on purpose.",
            )
        self._listener = _listener(wanted)
        bound = self._listener.getsockname()
        place = bound if isinstance(bound, str) else bound[:2]
        self.address = str(StreamAddress(wanted.family, place))
        self._client: _Client | None = None
        self._knocked_s: float | None = None
        self._subject: StreamSubject | None = None
        self._frames: deque[StreamedFrame] = deque()
        self._end_seen = self._closed = False

    @property
    def ended(self) -> bool:
        """Whether a client has said that no frame follows, and all frames have been given."""
        return self._closed or (self._end_seen and not self._frames)

    def subject(self, timeout_s: float) -> StreamSubject | None:
        """The first client's subject."""
        deadline = time.monotonic() + timeout_s
        while self._subject is None and self._wait(deadline):
            pass
        return self._subject

    def next(self, timeout_s: float) -> StreamedFrame | None:
        """The next frame; also the time in which clients are answered."""
        deadline = time.monotonic() + timeout_s
        while not self._frames and not self._end_seen and self._wait(deadline):
            pass
        return None if self._closed or not self._frames else self._frames.popleft()

    def close(self) -> None:
        """Hang up and stop listening."""
        self._closed = True
        for one in (self._listener, self._client and self._client.connection):
            if one:
                one.close()
        place = StreamAddress.parse(self.address).place
        if isinstance(place, str) and os.path.exists(place):
            os.unlink(place)

    def _wait(self, deadline: float) -> bool:
        """Answer whoever wants something until the deadline; False once it has passed."""
        left = deadline - time.monotonic()
        if self._closed or left <= 0:
            return False
        connection = self._client and self._client.connection
        knock_noted = connection is not None and self._knocked_s is not None
        readers = [one for one in (connection, None if knock_noted else self._listener) if one]
        try:
            ready, _, _ = select.select(readers, [], [], min(left, _LONGEST_WAIT_S))
            if self._client is not None and connection in ready:
                self._receive(self._client)
            if self._listener in ready or knock_noted:
                self._answer_knock(client_pauses=connection not in ready)
        except (OSError, ValueError):
            if not self._closed:  # else the sockets were closed meanwhile
                raise
        return True

    def _answer_knock(self, client_pauses: bool) -> None:
        """Admit or refuse the client that waits at the listener, once it is clear which."""
        now = time.monotonic()
        silent = self._client is None or now - self._client.heard_s >= _SILENCE_S
        if not silent:
            self._knocked_s = now if self._knocked_s is None else self._knocked_s
            if now - self._knocked_s < (_KNOCK_S if client_pauses else _LONGEST_KNOCK_S):
                return
        self._knocked_s = None
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:  # it did not wait so long
            return
        if not silent:
            self._refuse(connection, "another client is connected.")
            connection.close()
            return
        if self._client is not None:
            self._hang_up(self._client)
        connection.setblocking(False)
        self._client = _Client(connection, now)

    def _receive(self, client: _Client) -> None:
        try:
            data = client.connection.recv(_CHUNK_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._hang_up(client)
            return
        client.heard_s = time.monotonic()
        try:
            for record in client.reader.feed(data):
                self._take(client, record, client.heard_s)
                client.garbage_at_last_record = client.reader.garbage_bytes
        except UserError as error:
            self._refuse(client.connection, str(error))
            self._hang_up(client)
            return
        self._note_garbage(client)
        # Who does not speak this format at all is no client of ours.
        allowed = _MOST_GARBAGE_BYTES if client.subject is not None else 0
        if client.reader.garbage_bytes - client.garbage_at_last_record > allowed:
            self._refuse(client.connection, "this is no stream of records.")
            self._hang_up(client)

    def _take(self, client: _Client, record: wire.Record, now: float) -> None:
        if record.kind == wire.SUBJECT:
            client.subject = self._admit(wire.parse_subject(record))
            _answer(client.connection, ACCEPTED)
        elif client.subject is None:
            raise UserError("A stream begins with its subject.", "Send it first.")
        elif record.kind == wire.END:
            self._end_seen = True
        elif record.kind == wire.FRAME:
            try:
                self._frames.append(wire.parse_frame(record, client.subject, now))
            except UserError:
                self.counts["unreadable"] += 1

    def _admit(self, subject: StreamSubject) -> StreamSubject:
        """The subject, if it is the stream's; raises UserError if not."""
        if self._subject is None:
            self._subject = subject
            return subject
        self.counts["reconnects"] += 1
        mine = self._subject
        if (subject.width, subject.height) != (mine.width, mine.height):
            raise UserError(
                f"The stream began with images of {mine.width} x {mine.height} pixels, this "
                f"client's are {subject.width} x {subject.height}.",
                "Keep to one size.",
            )
        if subject.layout != mine.layout or not _same_head(subject, mine):
            raise UserError(
                f"The stream began with the head '{mine.arrays.name}', this client's is another.",
                "Keep to one head model.",
            )
        return subject

    def _hang_up(self, client: _Client) -> None:
        client.reader.close()
        self._note_garbage(client)
        client.connection.close()
        if client is self._client:
            self._client = None
        if client.subject is not None and not self._end_seen:
            self.counts["source lost"] += 1

    def _note_garbage(self, client: _Client) -> None:
        self.counts["garbage bytes"] += client.reader.garbage_bytes - client.garbage_noted
        client.garbage_noted = client.reader.garbage_bytes

    def _refuse(self, connection: socket.socket, reason: str) -> None:
        self.counts["refused clients"] += 1
        _answer(connection, REFUSED + reason.encode() + b"\n")
        # Closing while something is unread would reset the connection, and the answer be lost.
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_WR)
            connection.settimeout(_FAREWELL_S)
            unread = _MOST_GARBAGE_BYTES
            while unread > 0 and (data := connection.recv(_CHUNK_BYTES)):
                unread -= len(data)


def _answer(connection: socket.socket, line: bytes) -> None:
    with contextlib.suppress(OSError):  # it may have gone, which the next receive will tell
        connection.send(line)


def _same_head(one: StreamSubject, other: StreamSubject) -> bool:
    a, b = one.arrays, other.arrays
    return a is b or (
        a.name == b.name
        and a.v_template.shape == b.v_template.shape
        and np.array_equal(a.v_template, b.v_template)
        and np.array_equal(a.shapedirs, b.shapedirs)
    )


def _listener(address: StreamAddress) -> socket.socket:
    listener = socket.socket(address.family, socket.SOCK_STREAM)
    try:
        if isinstance(address.place, str):
            _remove_stale(address.place)
            listener.bind(address.place)
            os.chmod(address.place, 0o600)
        else:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address.place)
        listener.listen(4)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise UserError(
            f"Frames cannot be listened for at {address}: {error.strerror}.",
            "Choose another address, or end the program that uses this one.",
        ) from None
    return listener


def _remove_stale(path: str) -> None:
    """Remove a socket that nobody listens at any more."""
    if not os.path.exists(path) or not stat.S_ISSOCK(os.stat(path).st_mode):
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(path)
        except OSError:
            os.unlink(path)
