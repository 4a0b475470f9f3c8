import contextlib
from collections.abc import Iterator

import pytest

from rgbavatar_ns.data.streams import SocketStream
from rgbavatar_ns.head import HeadModel
from tests.data.streaming import DEADLINE_S, Opener


@pytest.fixture(scope="session")
def head() -> HeadModel:
    return HeadModel.embedded()


@pytest.fixture
def open_stream() -> Iterator[Opener]:
    with contextlib.ExitStack() as opened:

        def opener(listen: str = "127.0.0.1:0", **options) -> SocketStream:
            stream = SocketStream(listen, **options)
            opened.callback(stream.close)
            return stream

        yield opener


@pytest.fixture
def stream(open_stream: Opener) -> SocketStream:
    """One that waits for whoever is about to go."""
    return open_stream(grace_s=DEADLINE_S)
