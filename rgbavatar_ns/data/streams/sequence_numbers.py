"""Which frames have been there already, by their numbers, in bounded memory."""

from typing import Any, Literal

_REMEMBERED = 4096

Verdict = Literal["new", "late", "duplicate", "too late"]


class SeenNumbers:
    """Tells new frames from those that come late (after a higher number) or twice.

    "too late": so far behind the highest number that it is not known whether it came before.
    """

    def __init__(self) -> None:
        self.newest = -1
        """The highest number so far; -1 before the first."""
        self._seen: set[int] = set()

    def add(self, number: int) -> Verdict:
        """Note a frame's number (not negative) and judge it."""
        if number <= self.newest - _REMEMBERED:
            return "too late"
        if number in self._seen:
            return "duplicate"
        verdict: Verdict = "new" if number > self.newest else "late"
        self.newest = max(number, self.newest)
        self._seen.add(number)
        if len(self._seen) > 2 * _REMEMBERED:
            self._seen = {one for one in self._seen if one > self.newest - _REMEMBERED}
        return verdict

    def state_dict(self) -> dict[str, Any]:
        """Plain values that `load_state_dict` goes on from."""
        return {"newest": self.newest, "seen": sorted(self._seen)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where `state_dict` was taken."""
        self.newest, self._seen = state["newest"], set(state["seen"])
