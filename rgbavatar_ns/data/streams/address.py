"""Where frames are pushed to: a port of this machine, or a socket in its file system."""

import ipaddress
import socket
from dataclasses import dataclass

from rgbavatar_ns.errors import UserError

DEFAULT_ADDRESS = "127.0.0.1:7070"
_UNIX = "unix:"


@dataclass(frozen=True)
class StreamAddress:
    """Family and address as Python's sockets take them."""

    family: socket.AddressFamily
    place: str | tuple[str, int]

    @classmethod
    def parse(cls, text: str) -> "StreamAddress":
        """Read HOST:PORT or unix:PATH; raises UserError for anything else."""
        if text.startswith(_UNIX):
            if not hasattr(socket, "AF_UNIX"):
                raise UserError("This system has no unix sockets.", f"Use {DEFAULT_ADDRESS}.")
            return cls(socket.AF_UNIX, text.removeprefix(_UNIX))
        host, _, port = text.rpartition(":")
        host = host.strip("[]")
        if not host or not port.isdecimal() or int(port) > 65535:
            raise UserError(
                f"'{text}' is no address for a stream.",
                f"Give HOST:PORT, for example {DEFAULT_ADDRESS}, or unix:PATH.",
            )
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return cls(family, (host, int(port)))

    @property
    def is_local(self) -> bool:
        """Whether only programs of this machine can reach it."""
        if isinstance(self.place, str):
            return True
        host = self.place[0]
        try:
            return ipaddress.ip_address(host).is_loopback
        except ValueError:
            return host == "localhost"

    def __str__(self) -> str:
        """As `parse` reads it."""
        if isinstance(self.place, str):
            return _UNIX + self.place
        host, port = self.place
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
