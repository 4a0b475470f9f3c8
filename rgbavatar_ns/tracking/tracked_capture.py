"""A camera or a file with the tracker that follows the head in it."""

from collections import Counter
from typing import Any

from rgbavatar_ns.tracking.config import TrackConfig
from rgbavatar_ns.tracking.input.capture import FrameCapture, OneSize


class TrackedCapture:
    """What performers and streams of tracked frames have in common.

    `tracker` serves in place of a `LiveTracker` of `config`.
    """

    def __init__(
        self, capture: FrameCapture, tracker: Any = None, config: TrackConfig | None = None
    ) -> None:
        self._capture = capture
        if tracker is None:
            # Imports mediapipe, which who brings a tracker need not have.
            from rgbavatar_ns.tracking.live import LiveTracker

            tracker = LiveTracker(config or TrackConfig())
        self._tracker = tracker
        self._counts: Counter[str] = Counter()
        self._of_one_size = OneSize(self._counts)
        self._closed = False

    @property
    def counts(self) -> Counter[str]:
        """Pictures without a face, skipped, and losses of the source, by name."""
        whole = self._counts + self._capture.counts
        for name in ("no face", "does not fit"):
            whole[name] = self._tracker.counts[name]
        return +whole

    def close(self) -> None:
        """Let go of source and tracker."""
        if not self._closed:
            self._closed = True
            self._capture.close()
            self._tracker.close()
