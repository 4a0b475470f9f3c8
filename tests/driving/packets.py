"""Packets of Live Link Face, packed by hand from the format's description."""

import struct
from collections.abc import Sequence


def packet(
    coefficients: Sequence[float],
    angles: Sequence[float] = (0.0, 0.0, 0.0),
    device: str = "A1B2",
    version: int = 6,
    frame: int = 1,
    count: int | None = None,
) -> bytes:
    """One frame at 60 a second: 52 coefficients, then nine angles, the eyes' being 0."""
    values = [*coefficients, *angles, *[0.0] * 6]
    name, subject = device.encode(), b"phone"
    return b"".join(
        [
            struct.pack(">B", version),
            struct.pack(">i", len(name)) + name,
            struct.pack(">i", len(subject)) + subject,
            struct.pack(">ifii", frame, 0.0, 60, 1),
            struct.pack(">B", len(values) if count is None else count),
            struct.pack(f">{len(values)}f", *values),
        ]
    )
