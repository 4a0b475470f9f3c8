"""Where frames are sent to: a port of this machine."""

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
