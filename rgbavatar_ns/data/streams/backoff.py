"""How long to wait before trying a lost source again."""


class Backoff:
    """Pauses that double from a quarter of a second to ten, until something works again."""

    def __init__(self, first_s: float = 0.25, longest_s: float = 10.0) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._next_s = first_s

    def pause_s(self) -> float:
        """Seconds to wait now; the next pause is twice as long."""
        pause, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        return pause

    def reset(self) -> None:
        """Begin with a short pause again."""
        self._next_s = self._first_s
