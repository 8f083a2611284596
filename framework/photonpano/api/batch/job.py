"""One run of a batch: a plain description of it."""

from __future__ import annotations

from dataclasses import dataclass

from photonpano.api.batch.sweeps import CAPTURE_KEY, SpecText
from photonpano.record.batch_row import BatchRow


@dataclass(frozen=True, slots=True)
class Job:
    """What a process needs to know to do one run of a batch. It can be pickled.

    Attributes:
        row: the capture, the run folder, and the swept settings.
        spec: the spec.
        overrides: what the run changes in it: the capture, the settings, and what is set for all runs.
        threads: how many threads it uses if the spec leaves that open.
        overwrite: as in `run`.
    """

    row: BatchRow
    spec: SpecText
    overrides: tuple[str, ...]
    threads: int
    overwrite: bool = False


def is_of_capture(where: str) -> bool:
    """Return whether a problem of a spec, by its path there, is one of the capture that a batch has put in."""
    return where in ("source", CAPTURE_KEY)
