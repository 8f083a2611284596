"""Steps that runs of panoramas and of poses share."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from photonpano.capture import capture_of
from photonpano.captures.fingerprint import capture_files
from photonpano.captures.obstacles import order_warning
from photonpano.captures.summary import require_photons
from photonpano.compiling import notify_on_first_compile
from photonpano.context import Progress
from photonpano.errors import InputError, OutputError
from photonpano.pipeline.components import open_source
from photonpano.pipeline.observers import Observers
from photonpano.pipeline.run_folder import RunFolder, run_folder
from photonpano.protocols import Source
from photonpano.record.environment import peak_memory_bytes
from photonpano.record.schema import RunRecord
from photonpano.report import loading_figures
from photonpano.specs.plan import Plan
from photonpano.threads import one_thread_inside
from photonpano.values import Decision

logger = logging.getLogger(__name__)

COMPILING = "compiling for this machine, once; `photonpano warm-up` does it beforehand"


@dataclass(frozen=True, slots=True, eq=False)
class BegunRun:
    """A run that has begun.

    Attributes:
        source: the capture, which shows something.
        folder: the run folder, which is written.
        finished: reports the record of the run to the observers.
        start: the time at which the capture was open, in seconds of `time.perf_counter`.
    """

    source: Source
    folder: RunFolder
    finished: Callable[[Mapping[str, Any]], None]
    start: float

    @property
    def seconds(self) -> float:
        """Seconds since the capture was open."""
        return time.perf_counter() - self.start


@contextmanager
def begun_run(plan: Plan, observers: Observers, progress: Progress, *, overwrite: bool) -> Iterator[BegunRun]:
    """Begin a run: tell the observers, open the capture, and lock the run folder.

    Raises:
        InputError: the capture cannot be used, or shows nothing.
        OutputError: the run folder cannot be written, or another process writes it.
        SpecError: a stage does not suit the capture.
    """
    with (
        observers.watching(plan.document) as finished,
        open_source(plan) as source,
        run_folder(plan.output.directory, overwrite=overwrite, inputs=_read_files(plan)) as folder,
        loading_figures(),
        one_thread_inside(),
        notify_on_first_compile(partial(progress.note, COMPILING)),
    ):
        start = time.perf_counter()
        _require_photons(plan, source)
        yield BegunRun(source, folder, finished, start)


def first_decisions(plan: Plan, source: Source) -> list[Decision]:
    """Return what was decided while the capture was opened; warn if its pixels seem to be in another order."""
    if warning := order_warning(source):
        logger.warning(warning)
    return [*plan.decisions, *capture_of(source).decisions]


def require_centre(plan: Plan, source: Source) -> None:
    """Refuse a principal point that does not lie in the frames: the camera is then that of larger ones."""
    if plan.camera.centre_px is None:
        return
    (x, y), (height, width) = plan.camera.centre_px, source.info.frame_shape
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(
            str(
                plan.place("camera.centre_px").problem(
                    f"({x:g}, {y:g}) does not lie in the frames of {height}x{width} px; a camera that was calibrated with "
                    "other frames has another principal point and focal length here: scale and shift both"
                )
            )
        )


def with_report(folder: RunFolder, record: RunRecord, draw: Callable[[RunRecord], str]) -> RunRecord:
    """Add the report to the run folder. The results are there already: what fails now is a warning."""
    try:
        folder.reopen()
        try:
            folder.write_report(draw(record))
        except Exception as error:
            logger.debug("the report failed", exc_info=True)
            warning = f"the report could not be drawn ({type(error).__name__}: {error}); all other files of the run are written"
            record = {**record, "warnings": [*record["warnings"], warning]}
        return folder.commit({**record, "peak_memory_bytes": peak_memory_bytes()})
    except OutputError as error:
        warning = f"the report could not be added ({error}); all other files of the run are written"
        return {**record, "warnings": [*record["warnings"], warning]}


def _read_files(plan: Plan) -> list[Path]:
    """Return the files that a run reads: the capture, and the spec."""
    return [*capture_files(plan), *([] if plan.file is None else [plan.file])]


def _require_photons(plan: Plan, source: Source) -> None:
    """Refuse a capture that is all dark or all lit, at the place of the spec that names it."""
    try:
        require_photons(source)
    except InputError as error:
        raise InputError(str(plan.place("source").problem(str(error)))) from error
