"""Write a report of a run that fails, beside its run folder, which stays as it was."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from photonpano.atomic import atomic_path
from photonpano.captures.fingerprint import CaptureRecord
from photonpano.errors import CanvasTooLargeError, LocationError, PhotonpanoError, PluginError
from photonpano.motion.loop import LevelResult
from photonpano.pipeline.run_steps import BegunRun
from photonpano.record.run_json import level_record, started_record
from photonpano.record.schema import RunRecord
from photonpano.report import render_failure
from photonpano.specs.plan import Plan
from photonpano.values import Decision

logger = logging.getLogger(__name__)


def failure_path(directory: Path) -> Path:
    """Return where the report of a failed run lies: `runs/scan.failed.html` for `runs/scan`."""
    return directory.with_name(f"{directory.name}.failed.html")


@contextmanager
def reporting_failure(
    plan: Plan, begun: BegunRun, decisions: Sequence[Decision], finished: Sequence[LevelResult], capture: CaptureRecord
) -> Iterator[None]:
    """Write a report if the block raises; its path is the `report` of the error. That of the run before is removed first.

    Args:
        plan: what is run.
        begun: the run.
        decisions: what has been chosen from the capture so far.
        finished: the levels so far; one that was estimated again counts as it is last.
        capture: the fingerprint of the capture.
    """
    path = failure_path(begun.folder.directory)
    _removed(path)
    try:
        yield
    except (LocationError, CanvasTooLargeError, PluginError) as error:
        levels = {result.level.number: level_record(result) for result in finished}
        record: RunRecord = {
            **started_record(plan, begun.source.info, decisions, begun.seconds, capture),
            "status": "failed",
            "levels": [levels[number] for number in sorted(levels)],
        }
        error.report = _written(path, record, error)
        raise


def _removed(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        logger.debug("the report of an earlier failure could not be removed: %s", error)


def _written(path: Path, record: RunRecord, error: PhotonpanoError) -> Path | None:
    """Write the report; return None if that fails, too: the error of the run is what counts."""
    try:
        page = render_failure(record, error)
        with atomic_path(path) as temporary:
            temporary.write_text(page, encoding="utf-8")
    except Exception:
        logger.debug("the report of the failure could not be written", exc_info=True)
        return None
    return path
