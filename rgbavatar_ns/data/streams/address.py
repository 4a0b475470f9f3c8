"""Where frames are sent to, a port of this machine; and how an address is told."""

import contextlib
import ipaddress
from typing import NamedTuple
from urllib.parse import urlsplit

from rgbavatar_ns.errors import UserError

DEFAULT_ADDRESS = "127.0.0.1:7070"


class StreamAddress(NamedTuple):
    """Host and port."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> "StreamAddress":
        """Read HOST:PORT; raises UserError for anything else."""
        host = port = None
        with contextlib.suppress(ValueError):
            parts = urlsplit(f"//{text}")
            if parts.netloc == text and parts.username is None:
                host, port = parts.hostname, parts.port
        if not host or port is None:  # port 0 is any that is free
            raise UserError(
                f"'{text}' is no address for a stream.",
                f"Give HOST:PORT, for example {DEFAULT_ADDRESS}.",
            )
        return cls(host, port)

    @property
    def is_local(self) -> bool:
        """Whether only programs of this machine can reach it."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def __str__(self) -> str:
        """As `parse` reads it."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def told_address(address: str) -> str:
    """An address as anybody may read it: neither user nor password, nor anything that may be one.

    Cameras take a password before the host, in the query (left out), and in the path
    (`/user=...&password=...`, left out too). What is no address stays as it is.
    """
    scheme, mark, rest = address.partition("://")
    if not mark:
        return address
    place, _, asked = rest.partition("?")
    if "@" in asked:  # of a password with a question mark in it, perhaps
        return f"{scheme}://..."
    host, slash, path = place.rpartition("@")[2].partition("/")
    return f"{scheme}://{host}{slash}{'...' if '=' in path else path}"
