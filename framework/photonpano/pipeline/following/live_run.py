"""Read and locate frames as they arrive, and measure how far behind the run is."""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import replace

from photonpano.capture import Capture, capture_of
from photonpano.contracts.protocols import Source
from photonpano.corrections import without_still_pixels
from photonpano.errors import PhotonpanoError
from photonpano.execution.context import Context
from photonpano.pipeline.components import require_suitable, with_corrections
from photonpano.pipeline.following.arrivals import Arrivals, Delays
from photonpano.pipeline.following.located import LocatedSoFar, Window
from photonpano.report import LiveFigures
from photonpano.specs.plan import Plan
from photonpano.values import BoolArray

_LONG = 1_000_000  # assumed length of a capture that does not promise one, for checks of the stages


class ArrivedFrames:
    """Corrects the frames that have arrived. What stands still is found anew whenever twice as many frames are there."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._valid: BoolArray | None = None
        self._found_at = 0

    def of(self, arrived: Source, promised: int | None) -> Capture:
        """Return a capture with its corrections; errors as those of `build_source`."""
        source = with_corrections(self._plan, capture_of(arrived, self._plan.source.label))
        if not self._found_at:
            require_suitable(self._plan, source, replace(source.info, n_frames=promised or _LONG))
            self._found_at = 1
        if not self._plan.corrects_itself or source.info.kind != "binary" or source.info.bayer is not None:
            return source
        if self._valid is None or source.info.n_frames >= 2 * self._found_at:
            self._valid, self._found_at = without_still_pixels(source).valid, source.info.n_frames
        return replace(source, valid=self._valid)


logger = logging.getLogger(__name__)

_RATE_S = 3.0  # time over which the rate of arrival is measured
# Locating is too slow if frames wait longer than `_FAR_BEHIND_S`, `_STARTED_S` after the first were located.
_FAR_BEHIND_S, _STARTED_S = 2.0, 10.0


class LiveRun:
    """Locates frames as they arrive, and counts how long they have waited."""

    def __init__(self, plan: Plan, arrivals: Arrivals, context: Context) -> None:
        self._arrivals, self._delays = arrivals, Delays()
        self._reading, self._located = ArrivedFrames(plan), LocatedSoFar(plan, context)
        self._first_located: float | None = None
        self._failure = ""
        self._rates: deque[tuple[float, int]] = deque([(time.monotonic(), 0)])

    def next_window(self, *, last: bool) -> Window | None:
        """Locate the next frames; None if too few have come, or they cannot be located. `last` says that no more frames come.

        If locating fails, a warning says so, and no more frames are located; the run goes on, as the frames still come. What is
        wrong with the capture itself is raised.
        """
        arrived = self._arrivals.source()
        if arrived is None or self._failure:
            return None
        source, window = self._reading.of(arrived, self._arrivals.promised), None
        try:
            window = self._located.next_window(source, last=last)
        except PhotonpanoError as error:
            self._failure = f"frames are no longer located as they arrive: {error}"
            logger.warning(self._failure)
        now = time.monotonic()
        waited = self._arrivals.waited(self._located.n_frames, now)
        if window is not None:
            self._first_located = self._first_located or now
            for n_frames, seconds in waited:
                self._delays.add(n_frames, seconds)
        return window

    def figures(self) -> LiveFigures:
        """Return how far the run is."""
        now, n_frames, delays = time.monotonic(), self._arrivals.n_frames, self._delays
        return LiveFigures(
            state="following" if n_frames else "waiting",
            frames=n_frames,
            promised=self._arrivals.promised,
            located=delays.n_frames,
            behind_frames=n_frames - self._located.n_frames,
            behind_s=self._arrivals.oldest(now),
            frames_per_s=self._rate(now, n_frames),
            delay_mean_s=delays.mean,
            delay_95_s=delays.quantile(0.95),
            delay_longest_s=delays.longest,
            message=self._failure or self._located.problem,
        )

    @property
    def is_too_slow(self) -> bool:
        """Whether frames come faster than they are located."""
        now = time.monotonic()
        started = self._first_located is not None and now - self._first_located > _STARTED_S
        return started and not self._failure and self._arrivals.oldest(now) > _FAR_BEHIND_S

    def _rate(self, now: float, n_frames: int) -> float:
        """Return the frames a second of the last seconds."""
        if now - self._rates[-1][0] > _RATE_S / 10:
            self._rates.append((now, n_frames))
        while len(self._rates) > 2 and now - self._rates[1][0] > _RATE_S:
            self._rates.popleft()
        since, before = self._rates[0]
        return (n_frames - before) / max(now - since, 1e-6)


class Every:
    """A timer of what is done at intervals."""

    def __init__(self, seconds: float, *, at_once: bool = True) -> None:
        self._seconds = seconds
        self._next = time.monotonic() + (0.0 if at_once else seconds)

    def due(self) -> bool:
        """Return whether it is due now; then it is due again after that time."""
        if (now := time.monotonic()) < self._next:
            return False
        self._next = now + self._seconds
        return True
