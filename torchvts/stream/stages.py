"""Time of the stages of a frame."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

STAGES = ("read", "wait", "rectify", "depth", "motion", "draw", "view", "write")
"""In the order of a frame."""


class StageClock:
    """Measures the milliseconds of each stage, of the last 10,000 frames."""

    def __init__(self) -> None:
        self._frames: deque[dict[str, float]] = deque(maxlen=10_000)  # a camera may run for days
        self._now: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the time of the block, which is one of :data:`STAGES`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._now[name] = self._now.get(name, 0.0) + 1000.0 * (time.perf_counter() - start)

    def end_frame(self) -> None:
        """Close a frame: what was measured since the last call belongs to it."""
        self._frames.append(self._now)
        self._now = {}

    def median_ms(self) -> dict[str, float]:
        """Median of each stage over the frames in which it ran, in the order of a frame."""
        times = {name: [frame[name] for frame in self._frames if name in frame] for name in STAGES}
        return {name: float(np.median(ms)) for name, ms in times.items() if ms}
