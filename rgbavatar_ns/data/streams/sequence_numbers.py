"""Which frames have been there already, by their numbers, in bounded memory."""

from typing import Any, Literal

_REMEMBERED = 8192

Verdict = Literal["new", "late", "duplicate"]


class SeenNumbers:
    """Tells new frames from those that come late (after a higher number) or twice.

    The last 8192 are remembered in the order of their arrival, so that none, however large, makes
    others be taken for what they are not: numbers may as well be the time in microseconds.
    """

    def __init__(self) -> None:
        self.newest = -1
        """The highest number so far; -1 before the first."""
        self._last = -1
        self._seen: dict[int, None] = {}

    def add(self, number: int) -> Verdict:
        """Note a frame's number (not negative) and judge it: late is what is below the last one."""
        if number in self._seen:
            return "duplicate"
        verdict: Verdict = "new" if number > self._last else "late"
        self._last, self.newest = number, max(number, self.newest)
        self._seen[number] = None
        if len(self._seen) > _REMEMBERED:
            del self._seen[next(iter(self._seen))]
        return verdict

    def state_dict(self) -> dict[str, Any]:
        """Plain values that `load_state_dict` goes on from."""
        return {"newest": self.newest, "seen": list(self._seen)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken."""
        self.newest, self._seen = state["newest"], dict.fromkeys(state["seen"])
        self._last = next(reversed(self._seen), -1)
