"""One run of a batch, as its summary shows it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from photonpano.files.paths import Location
from photonpano.text import byte_size, count, duration, pixels

Status = Literal["waiting", "running", "done", "failed", "interrupted"]


def _px(value: float) -> str:
    return f"{pixels(value)} px"


def _percent(share: float) -> str:
    return f"{pixels(100 * share)} %"


# The figures of a run by their attributes: the title of each, and how it is written.
FIGURES: dict[str, tuple[str, Callable[[Any], str]]] = {
    "reduced_chi2": ("chi-square", "{:.3f}".format),
    "expected_error_px": ("expected error", _px),
    "true_error_px": ("true error", _px),
    "psnr_db": ("PSNR", "{:.1f} dB".format),
    "expected_position_error": ("expected error", _percent),
    "true_position_error": ("true error", _percent),
    "n_frames": ("frames", count),
    "seconds": ("time", duration),
    "peak_memory_bytes": ("peak memory", byte_size),
}


@dataclass(frozen=True, slots=True)
class BatchRow:
    """One run of a batch, as it is now.

    Attributes:
        name: of the capture, which is the name of its folder.
        capture: the file or folder, or its URL.
        settings: the swept keys of the spec with their values; empty without a sweep.
        directory: the run folder.
        status: "waiting", "running", "done", "failed", or "interrupted" for a run that the end of the batch has stopped.
        was_finished: whether the run was finished before, so that nothing was left to do.
        verdict: "trusted" or "doubtful"; None unless the run is done.
        reason: why it failed, is doubtful, or has no score; empty if there is nothing to say.
        reduced_chi2: how well the panorama explains the photons, see `photonpano.Verdict`; None without a panorama.
        expected_error_px: expected corner error of the motion, in px of a frame; None without a panorama.
        true_error_px: mean corner error against the truth beside the capture, in px of a frame; None without a truth.
        psnr_db: of the panorama against the true scene, in dB; None without a true scene.
        expected_position_error: expected error of the positions of the camera, as a share of the length of the path; None for
            a panorama.
        true_position_error: their error against the truth, as a share of the length of the path; None without a truth.
        n_frames: frames of the capture.
        seconds: time that the run took.
        peak_memory_bytes: the largest memory of the run; None where the system does not report it.
        report: the page of the run: `report.html` of its folder or, if it failed, the page beside that folder; None where there
            is none.
        thumbnail: the panorama as a data URI of a small JPEG; None without a panorama.
    """

    COLUMNS: ClassVar = (
        "capture",
        "verdict",
        "chi-square",
        "expected error",
        "true error",
        "frames",
        "time",
        "memory",
        "reason",
    )

    name: str
    capture: Location
    settings: Mapping[str, Any]
    directory: Path
    status: Status = "waiting"
    was_finished: bool = False
    verdict: str | None = None
    reason: str = ""
    reduced_chi2: float | None = None
    expected_error_px: float | None = None
    true_error_px: float | None = None
    psnr_db: float | None = None
    expected_position_error: float | None = None
    true_position_error: float | None = None
    n_frames: int | None = None
    seconds: float | None = None
    peak_memory_bytes: int | None = None
    report: Path | None = None
    thumbnail: str | None = field(default=None, repr=False)

    @property
    def label(self) -> str:
        """The name of the capture, and what the run has of its own: `night, resample.with.group_size=50`."""
        return ", ".join([self.name, *(f"{key}={written(value)}" for key, value in self.settings.items())])

    def cells(self) -> list[str]:
        """Return what stands in each of the `COLUMNS` of a table; a dash where the run has no such figure."""
        expected = "expected_error_px" if self.expected_position_error is None else "expected_position_error"
        true = "true_error_px" if self.true_position_error is None else "true_position_error"
        figures = ("reduced_chi2", expected, true, "n_frames", "seconds", "peak_memory_bytes")
        return [self.label, self.verdict or self.status, *map(self.figure, figures), self.reason]

    def figure(self, name: str) -> str:
        """Return one of the `FIGURES`, written with its unit; a dash where the run has none."""
        value = getattr(self, name)
        return "\N{EN DASH}" if value is None else FIGURES[name][1](value)


def ranked(rows: Iterable[BatchRow]) -> list[BatchRow]:
    """Order the runs of each capture, the best first: trusted before doubtful before others, then by their reduced chi-square.

    The captures stay in their order.
    """
    captures: dict[str, list[BatchRow]] = {}
    for row in rows:
        captures.setdefault(row.name, []).append(row)

    def place(row: BatchRow) -> tuple[int, float]:
        chi2 = math.inf if row.reduced_chi2 is None else row.reduced_chi2
        return ("trusted", "doubtful", None).index(row.verdict), chi2

    return [row for runs in captures.values() for row in sorted(runs, key=place)]


def written(value: Any) -> str:
    """Write a value of a spec in a line, as in an override: text without quotes where it needs none."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
