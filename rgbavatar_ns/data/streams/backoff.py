"""How long to wait before trying a lost source again."""

_FIRST_S, _LONGEST_S = 0.25, 10.0


class Backoff:
    """Pauses that double from a quarter of a second to ten, until something works again."""

    def __init__(self, first_s: float = _FIRST_S, longest_s: float = _LONGEST_S) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._next_s = first_s

    def pause_s(self) -> float:
        """Seconds to wait now; the next pause is twice as long."""
        pause, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        return pause

    def reset(self) -> None:
        """Begin with a short pause again."""
        self._next_s = self._first_s
