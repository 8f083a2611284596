"""Render the report of a run as an HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from photonpano.merging.panorama import RenderedPanorama
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.loop import LevelResult
from photonpano.protocols import Source
from photonpano.record.schema import RunRecord
from photonpano.report import figures, residual_figures
from photonpano.report.drawing import jpeg_uri, shrunk
from photonpano.report.environment import filled, yaml_of
from photonpano.report.tables import failure_groups, listed_files
from photonpano.report.viewer import viewer_data
from photonpano.residuals.refinement import Explained
from photonpano.values import Light, true_spans

PICTURE_PIXELS = 1600  # longer side of the panorama on the page; the files of the run folder have all pixels

MAX_SPANS = 12  # number of spans of frames that are listed


@dataclass(frozen=True, slots=True, eq=False)
class OpenCapture:
    """A capture that the viewer of a report reads, as the panorama was rendered from it, with the levels of its motion."""

    source: Source
    levels: Sequence[LevelResult]


def render_report(
    record: RunRecord,
    explained: Explained,
    panorama: RenderedPanorama,
    light: Light | None = None,
    capture: OpenCapture | None = None,
) -> str:
    """Return the report of a run as one HTML page that needs no other file and no network.

    A script in it shows the panorama in a viewer, unless there is no capture; where scripts are off, all figures are there.
    """
    files, more_files = listed_files(record.get("files", {}))
    return filled(
        "report.html",
        **head_of(record),
        stages=figures.STAGE_NAMES,
        failures=failure_groups(record["levels"]),
        stage_times=figures.stage_times(record["levels"], record["panorama"]) if record["levels"] else None,
        files=files,
        more_files=more_files,
        viewer=None if capture is None else viewer_data(record, explained, panorama, capture.source, capture.levels),
        **_results(record, explained, panorama, light),
    )


def head_of(record: RunRecord) -> dict[str, Any]:
    """Return what the pages of all runs show."""
    return {
        "record": record,
        "warnings": record["warnings"],
        "title": _title(record),
        "created": datetime.fromisoformat(record["created"]).strftime("%d %B %Y, %H:%M %Z").strip(),
        "capture_seconds": _capture_seconds(record),
        "spec_yaml": yaml_of(record["spec"]),
    }


def _results(record: RunRecord, explained: Explained, panorama: RenderedPanorama, light: Light | None) -> dict[str, Any]:
    canvas = panorama.canvas
    flicker = residual_figures.flicker_over_panorama(light, canvas)
    motion = _motion(record, explained.motion, panorama)
    return motion | _unexplained(record, explained, panorama) | {"flicker_over_panorama": flicker}


def _unexplained(record: RunRecord, explained: Explained, panorama: RenderedPanorama) -> dict[str, Any]:
    residuals, canvas = explained.residuals, panorama.canvas
    return {
        "misfit": float(residuals.misfit.mean()),
        "misfit_over_panorama": residual_figures.misfit_over_panorama(residuals, explained.canvas, canvas),
        "over_sensor": residual_figures.over_sensor(residuals),
        "shifts_are_drawn": residual_figures.significant_shifts(residuals) is not None,
        "shifts_over_time": residual_figures.shifts_over_time(residuals, record["source"]["frame_rate_hz"]),
        "light_over_time": residual_figures.light_over_time(residuals),
        "span_frames": int(np.median([len(span) for span in residuals.spans])),
    }


def _motion(record: RunRecord, motion: FrameMotion, panorama: RenderedPanorama) -> dict[str, Any]:
    not_located = true_spans(~motion.located)
    return {
        "picture": jpeg_uri(shrunk(panorama.picture, PICTURE_PIXELS)),
        "picture_is_smaller": max(panorama.picture.shape[:2]) > PICTURE_PIXELS,
        "path_on_panorama": figures.path_on_panorama(motion, panorama),
        "path_over_time": figures.path_over_time(motion, record["source"]["frame_rate_hz"]),
        "coverage_map": figures.coverage_map(panorama.thumbnail.weight),
        "turns": motion.camera is not None,
        "projection": panorama.canvas.projection,
        "reference": motion.reference,
        "n_not_located": int((~motion.located).sum()),
        "not_located": not_located[:MAX_SPANS],
        "more_not_located": len(not_located[MAX_SPANS:]),
    }


def _title(record: RunRecord) -> str:
    return Path(record["spec_file"]).stem if record["spec_file"] else "A run without a spec file"


def _capture_seconds(record: RunRecord) -> float | None:
    rate = record["source"]["frame_rate_hz"]
    return None if rate is None else record["source"]["n_frames"] / rate
