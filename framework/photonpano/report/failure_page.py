"""Render the report of a run that failed: the exposures that did not match, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonpano.errors import PhotonpanoError
from photonpano.motion.diagnosis import UntiedError
from photonpano.photometry import picture_of
from photonpano.record.run_json import failure_records
from photonpano.record.schema import FailureRecord, RunRecord
from photonpano.report import figures
from photonpano.report.drawing import jpeg_uri, shrunk
from photonpano.report.environment import filled
from photonpano.report.page import FailureGroup, failure_groups, head_of
from photonpano.values import NotLocated, VirtualExposure

MAX_PAIRS = 8  # number of pairs whose exposures are shown
EXPOSURE_PIXELS = 480  # longer side of an exposure on the page
_WHITE_QUANTILE = 0.995


@dataclass(frozen=True, slots=True)
class ShownPair:
    """A pair that was not located, with its exposures as data URIs."""

    failure: FailureRecord
    moving: str
    fixed: str


def render_failure(record: RunRecord, error: PhotonpanoError) -> str:
    """Return the report of a run that failed as one HTML page that needs no other file and no network.

    The record has the status "failed" and the levels that were finished. Of an `UntiedError` the page shows the pairs that were
    not located.
    """
    lost = error if isinstance(error, UntiedError) else None
    failed = [] if lost is None else failure_records(lost.groups, lost.edges)
    groups = [] if lost is None else failure_groups([{"level": lost.level, "failures": failed}])
    return filled(
        "failure.html",
        **head_of(record),
        lines=_lines(error),
        level=None if lost is None else lost.level,
        lost_groups=groups,
        n_pairs=0 if lost is None else len(lost.edges),
        n_failed=len(failed),
        parts=None if lost is None else figures.tied_parts(lost.groups, lost.parts),
        pairs=[] if lost is None else _shown(lost, failed, groups),
        places=[] if lost is None else _ends_of_parts(lost),
        stages=figures.STAGE_NAMES,
        failures=failure_groups(record["levels"]),
    )


def _lines(error: PhotonpanoError) -> list[str]:
    """Return the sentences of the error; the pairs that it lists are shown with their exposures."""
    lines = str(error).splitlines()
    return [line for line in lines if not line.startswith("  ")] if isinstance(error, UntiedError) else lines


def _shown(lost: UntiedError, failures: Sequence[FailureRecord], groups: Sequence[FailureGroup]) -> list[ShownPair]:
    """Return some pairs of each reason with their exposures; none where these cannot be merged again."""
    if lost.merged is None:
        return []
    edges = [edge for edge in lost.edges if isinstance(edge.motion, NotLocated)]
    edge_of = {id(failure): edge for failure, edge in zip(failures, edges, strict=True)}
    each = max(1, MAX_PAIRS // max(1, len(groups)))
    found = []
    for failure in [failure for group in groups for failure in _spread(group.failures, each)][:MAX_PAIRS]:
        edge = edge_of[id(failure)]
        moving, fixed = _pictures([lost.merged(edge.moving), lost.merged(edge.fixed)])
        found.append(ShownPair(failure, moving, fixed))
    return found


def _ends_of_parts(lost: UntiedError) -> list[dict[str, Any]]:
    """Return the first and the last exposure of each part that is tied together, where points can be clicked to tie parts."""
    if lost.merged is None:
        return []
    parts = [np.flatnonzero(lost.parts == part) for part in np.flatnonzero(np.bincount(lost.parts) > 1)[:MAX_PAIRS]]
    ends = sorted({int(part[end]) for part in parts for end in (0, -1)}) if len(parts) > 1 else []
    return [{"frame": int(lost.groups[index].reference), "uri": _pictures([lost.merged(index)])[0]} for index in ends]


def _spread(failures: Sequence[FailureRecord], most: int) -> list[FailureRecord]:
    """Return failures from the first to the last, evenly spaced."""
    return [failures[index] for index in np.unique(np.linspace(0, len(failures) - 1, min(most, len(failures))).astype(int))]


def _pictures(pair: Sequence[VirtualExposure]) -> list[str]:
    """Return exposures as data URIs, of one brightness."""
    seen = np.concatenate([exposure.flux[np.isfinite(exposure.flux)] for exposure in pair])
    white = (float(np.quantile(seen, _WHITE_QUANTILE)) if seen.size else 0.0) or 1.0
    return [jpeg_uri(shrunk(picture_of(exposure.flux, white), EXPOSURE_PIXELS)) for exposure in pair]
