"""Steps that runs of panoramas and of poses share."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from photonpano.captures.fingerprint import capture_files
from photonpano.captures.summary import require_photons
from photonpano.errors import InputError, OutputError
from photonpano.pipeline.run_folder import RunFolder
from photonpano.protocols import Source
from photonpano.record.run_json import peak_memory_bytes
from photonpano.record.schema import RunRecord
from photonpano.specs.plan import Plan

logger = logging.getLogger(__name__)

COMPILING = "compiling for this machine, once; `photonpano warm-up` does it beforehand"


def read_files(plan: Plan) -> list[Path]:
    """Return the files that a run reads: the capture, and the spec."""
    return [*capture_files(plan), *([] if plan.file is None else [plan.file])]


def require_photons_of(plan: Plan, source: Source) -> None:
    """Refuse a capture that is all dark or all lit, at the place of the spec that names it."""
    try:
        require_photons(source)
    except InputError as error:
        raise InputError(str(plan.place("source").problem(str(error)))) from error


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
