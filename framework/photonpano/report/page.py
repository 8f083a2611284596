"""Render the report of a run as an HTML page, with tables of its files and of the pairs that were not located."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypedDict
from urllib.parse import quote

import numpy as np

from photonpano.contracts.protocols import Source
from photonpano.merging.panorama import RenderedPanorama
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.loop import LevelResult
from photonpano.record.contents import RECORD
from photonpano.record.schema import FailureRecord, FileContent, LevelRecord, RunRecord
from photonpano.report import figures
from photonpano.report.drawing import filled, jpeg_uri, shrunk, yaml_of
from photonpano.report.viewer import viewer_data
from photonpano.residuals.refinement import Explained
from photonpano.text import counted
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
        files=files,
        more_files=more_files,
        viewer=None if capture is None else viewer_data(record, explained, panorama, capture.source, capture.levels),
        flicker_over_panorama=figures.flicker_over_panorama(light, panorama.canvas),
        **_motion(record, explained.motion, panorama),
        **_unexplained(record, explained, panorama),
    )


def head_of(record: RunRecord) -> dict[str, Any]:
    """Return what the pages of all runs show."""
    rate, file = record["source"]["frame_rate_hz"], record["spec_file"]
    return {
        "record": record,
        "warnings": record["warnings"],
        "title": Path(file).stem if file else "A run without a spec file",
        "created": datetime.fromisoformat(record["created"]).strftime("%d %B %Y, %H:%M %Z").strip(),
        "capture_seconds": None if rate is None else record["source"]["n_frames"] / rate,
        "spec_yaml": yaml_of(record["spec"]),
    }


def _unexplained(record: RunRecord, explained: Explained, panorama: RenderedPanorama) -> dict[str, Any]:
    residuals, canvas = explained.residuals, panorama.canvas
    return {
        "reduced_chi2": float(residuals.reduced_chi2.mean()),
        "chi2_over_panorama": figures.chi2_over_panorama(residuals, explained.canvas, canvas),
        "over_sensor": figures.over_sensor(residuals),
        "shifts_are_drawn": figures.significant_shifts(residuals) is not None,
        "shifts_over_time": figures.shifts_over_time(residuals, record["source"]["frame_rate_hz"]),
        "halves_over_time": figures.halves_over_time(explained.halves, residuals.spans[-1].stop),
        "detail_over_frequency": figures.detail_over_frequency(record.get("detail")),
        "light_over_time": figures.light_over_time(residuals),
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


MAX_FILES = 30  # number of files that are listed

_CONTENTS = {
    "panorama.tiff": "linear flux in photons per pixel per frame, float32; NaN where nothing was seen",
    "panorama.png": "the panorama to look at, 8 bits",
    "coverage.tiff": "the number of frames that saw each pixel of the panorama, float32",
    "panorama-std.tiff": "the standard deviation of the flux of each pixel, float32",
    "first-frame.tiff": "the first frame that saw each pixel, uint32; 4294967295 where none did",
    "last-frame.tiff": "the last frame that saw each pixel, uint32; 4294967295 where none did",
    "trajectory.npz": "the motion of every frame",
    "light.npz": "the gain of the light in each frame",
    "layers.npz": "which parts of the frames show the background, and which something that hides it",
    "vignette.npz": "the relative sensitivity of each pixel",
    "panorama.exr": "linear flux, for programs that work with a large range",
    "panorama.hdr": "linear flux, for programs that work with a large range",
    "panorama.ome.zarr/": "flux, weight, standard deviation and saturated pixels in tiles, for viewers",
    "exposures/": "the exposures of each level, linear flux and pictures",
    RECORD: "the record: inputs, versions, choices and results",
}


@dataclass(frozen=True, slots=True)
class ListedFile:
    """A file of a run folder, or a folder in it, whose name ends in a slash."""

    name: str
    link: str
    bytes: int | None  # its size, with all that a folder holds; None where it is not known yet
    content: str  # what it holds; empty where only its writer knows


def listed_files(files: Mapping[str, FileContent]) -> tuple[list[ListedFile], int]:
    """Return the first files and folders of a run, best known first, and the number of the others.

    A folder is one row: it may hold thousands of pictures. run.json, which does not list itself, is added.
    """
    sizes: dict[str, list[int]] = defaultdict(list)
    for path, content in files.items():
        first, slash, _ = path.partition("/")
        sizes[first + slash].append(content["bytes"])
    order = {name: place for place, name in enumerate(_CONTENTS)}
    names = sorted({*sizes, RECORD} - {"report.html"}, key=lambda name: (order.get(name, len(order)), name))
    listed = [
        ListedFile(name, quote(f"./{name}"), sum(sizes[name]) if name in sizes else None, _content(name, len(sizes[name])))
        for name in names[:MAX_FILES]
    ]
    return listed, len(names) - len(listed)


def _content(name: str, n_files: int) -> str:
    """Return what a file holds, or a folder."""
    content = _CONTENTS.get(name, "")
    return ": ".join(filter(None, (counted(n_files, "file"), content))) if name.endswith("/") else content


MAX_EXAMPLES = 3  # number of pairs of a group that are listed


class FailedLevel(TypedDict):
    """The pairs of a level that were not located."""

    level: int
    failures: Sequence[FailureRecord]


@dataclass(frozen=True, slots=True)
class FailureGroup:
    """Pairs of one level, in order, that failed for the same reason, apart from the numbers in it."""

    level: int
    failures: tuple[FailureRecord, ...]

    @property
    def reason(self) -> str:
        """The reason of the first pair, with its numbers."""
        return self.failures[0]["reason"]

    @property
    def alike(self) -> bool:
        """Whether all pairs have the same reason, numbers included."""
        return len({failure["reason"] for failure in self.failures}) == 1

    @property
    def examples(self) -> tuple[FailureRecord, ...]:
        """The first pairs."""
        return self.failures[:MAX_EXAMPLES]

    @property
    def more(self) -> int:
        """Number of pairs that are not among the examples."""
        return len(self.failures) - len(self.examples)


def failure_groups(levels: Sequence[LevelRecord | FailedLevel]) -> list[FailureGroup]:
    """Group the failures of each level by reason, the largest groups first."""
    groups = []
    for level in levels:
        alike: dict[str, list[FailureRecord]] = {}
        for failure in level["failures"]:
            alike.setdefault(re.sub(r"[-+]?\d+(\.\d+)?", "#", failure["reason"]), []).append(failure)
        by_size = sorted(alike.values(), key=len, reverse=True)
        groups += [FailureGroup(level["level"], tuple(failures)) for failures in by_size]
    return groups
