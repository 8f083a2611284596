"""Pages beside the report of a run: of a run that failed or follows a capture, of runs side by side, and of a batch."""

from __future__ import annotations

import importlib.metadata
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Any, Literal, cast
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import PhotonpanoError
from photonpano.motion.diagnosis import UntiedError
from photonpano.photometry import picture_of
from photonpano.plugins.description import flow
from photonpano.record.batch_row import FIGURES, BatchRow, written
from photonpano.record.run_json import failure_records
from photonpano.record.schema import FailureRecord, RunRecord
from photonpano.report.drawing import (
    INK,
    MUTED,
    SERIES,
    WIDTH_IN,
    Margins,
    add_axes,
    filled,
    jpeg_uri,
    mark_frames,
    mark_logarithmic,
    plain_figure,
    shrunk,
    svg_of,
    yaml_of,
)
from photonpano.report.figures import STAGE_NAMES, instants_of, tied_parts
from photonpano.report.page import FailureGroup, failure_groups, head_of
from photonpano.text import byte_size, count, duration, pixels, share
from photonpano.values import FloatArray, NotLocated, VirtualExposure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_PAIRS = 8  # number of pairs whose exposures are shown
_EXPOSURE_PIXELS = 480  # longer side of an exposure on the page
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
        lines=_lines_of(error),
        level=None if lost is None else lost.level,
        lost_groups=groups,
        n_pairs=0 if lost is None else len(lost.edges),
        n_failed=len(failed),
        parts=None if lost is None else tied_parts(lost.groups, lost.parts),
        pairs=[] if lost is None else _shown(lost, failed, groups),
        places=[] if lost is None else _ends_of_parts(lost),
        stages=STAGE_NAMES,
        failures=failure_groups(record["levels"]),
    )


def _lines_of(error: PhotonpanoError) -> list[str]:
    """Return the sentences of the error; the pairs that it lists are shown with their exposures."""
    lines = str(error).splitlines()
    return [line for line in lines if not line.startswith("  ")] if isinstance(error, UntiedError) else lines


def _shown(lost: UntiedError, failures: Sequence[FailureRecord], groups: Sequence[FailureGroup]) -> list[ShownPair]:
    """Return some pairs of each reason with their exposures; none where these cannot be merged again."""
    if lost.merged is None:
        return []
    edges = [edge for edge in lost.edges if isinstance(edge.motion, NotLocated)]
    edge_of = {id(failure): edge for failure, edge in zip(failures, edges, strict=True)}
    each = max(1, _MAX_PAIRS // max(1, len(groups)))
    found = []
    for failure in [failure for group in groups for failure in _spread(group.failures, each)][:_MAX_PAIRS]:
        edge = edge_of[id(failure)]
        moving, fixed = _pictures([lost.merged(edge.moving), lost.merged(edge.fixed)])
        found.append(ShownPair(failure, moving, fixed))
    return found


def _ends_of_parts(lost: UntiedError) -> list[dict[str, Any]]:
    """Return the first and the last exposure of each part that is tied together, where points can be clicked to tie parts."""
    if lost.merged is None:
        return []
    parts = [np.flatnonzero(lost.parts == part) for part in np.flatnonzero(np.bincount(lost.parts) > 1)[:_MAX_PAIRS]]
    ends = sorted({int(part[end]) for part in parts for end in (0, -1)}) if len(parts) > 1 else []
    return [{"frame": int(lost.groups[index].reference), "uri": _pictures([lost.merged(index)])[0]} for index in ends]


def _spread(failures: Sequence[FailureRecord], most: int) -> list[FailureRecord]:
    """Return failures from the first to the last, evenly spaced."""
    return [failures[index] for index in np.unique(np.linspace(0, len(failures) - 1, min(most, len(failures))).astype(int))]


def _pictures(pair: Sequence[VirtualExposure]) -> list[str]:
    """Return exposures as data URIs, of one brightness."""
    seen = np.concatenate([exposure.flux[np.isfinite(exposure.flux)] for exposure in pair])
    white = (float(np.quantile(seen, _WHITE_QUANTILE)) if seen.size else 0.0) or 1.0
    return [jpeg_uri(shrunk(picture_of(exposure.flux, white), _EXPOSURE_PIXELS)) for exposure in pair]


_MOST_DIFFERENCES = 60  # number of settings that are listed


@dataclass(frozen=True, slots=True, eq=False)
class ComparedRun:
    """A run that is compared with others."""

    name: str  # short, and different from those of the others
    folder: Path
    record: RunRecord
    picture: NDArray[np.uint8]  # (H, W) or (H, W, 3) uint8, its panorama on the canvas of the first run
    # (T,) mean distance of the corners of each frame from where the first run has them, after the best alignment of the planes,
    # in px of a frame; NaN where either has not located it; None for the first run
    difference_px: FloatArray | None
    corner_error_px: float | None = None  # mean distance of the corners from their true places; None without a truth
    psnr_db: float | None = None  # of the panorama; None without a true scene
    ssim: float | None = None  # likewise

    @property
    def mean_difference_px(self) -> float | None:
        """The mean difference over the frames that both runs located; None for the first run."""
        return None if self.difference_px is None else float(np.nanmean(self.difference_px))


def render_comparison(runs: Sequence[ComparedRun], output: Path) -> str:
    """Return the page as HTML that needs no other file and no network, and links to the reports of at least two runs."""
    first = runs[0].record
    shown, hidden = _differing([run.record["spec"] for run in runs])
    return filled(
        "comparison.html",
        title=", ".join(run.name for run in runs),
        version=importlib.metadata.version("photonpano"),
        source=first["source"],
        runs=runs,
        links=[_link_of_run(run.folder, output) for run in runs],
        pictures=[jpeg_uri(run.picture) for run in runs],
        rows=_rows(runs),
        settings=shown,
        more_settings=hidden,
        differences=_differences_over_time(runs) if any(run.mean_difference_px for run in runs) else None,
    )


def _differences_over_time(runs: Sequence[ComparedRun]) -> str:
    """Draw how far the motion of each run is from that of the first, frame by frame."""
    others = [run for run in runs if run.difference_px is not None]
    with plain_figure(WIDTH_IN, 3.0) as figure:
        [axes] = add_axes(figure, Margins(right=0.3, top=0.4))
        for run, colour in zip(others, [*SERIES, *(INK for _ in others)], strict=False):
            assert run.difference_px is not None
            frames = instants_of(len(run.difference_px))
            axes.plot(frames, run.difference_px[frames], color=colour, label=run.name)
        mark_logarithmic(axes)
        axes.set_ylabel("difference (px)")
        mark_frames(axes, 0, runs[0].record["source"]["n_frames"])
        figure.legend(loc="upper left", ncols=5, handlelength=1.2)
        return svg_of(figure, "differences")


def _link_of_run(folder: Path, output: Path) -> str:
    """Return the address of the report of a run, or of its folder, relative to the page."""
    report = folder / "report.html"
    return quote(os.path.relpath(report if report.is_file() else folder, output.absolute().parent))


def _rows(runs: Sequence[ComparedRun]) -> list[tuple[str, list[str]]]:
    """Return the table of scores: a name, and a text for each run. A row that no run has is left out."""

    def row(name: str, value: Callable[[ComparedRun], Any], how: Callable[[Any], str]) -> tuple[str, list[str | None]]:
        values = [value(run) for run in runs]
        return name, [None if each is None else how(each) for each in values]

    def part(key: str, name: str) -> Callable[[ComparedRun], Any]:
        return lambda run: (cast(Any, run.record)[key] or {}).get(name)

    def last(name: str) -> Callable[[ComparedRun], Any]:
        return lambda run: cast(Any, run.record)["levels"][-1][name] if run.record["levels"] else None

    rows = [
        row("corner error (px)", lambda run: run.corner_error_px, pixels),
        row("PSNR (dB)", lambda run: run.psnr_db, "{:.2f}".format),
        row("SSIM", lambda run: run.ssim, "{:.4f}".format),
        row("difference of the motion (px)", lambda run: run.mean_difference_px, pixels),
        row("verdict", part("verdict", "status"), str),
        row("expected error (px)", part("motion", "std_px"), pixels),
        row("scatter of short spans (noise = 1)", part("verdict", "residual_ratio"), pixels),
        row("reduced chi-square of the photons (noise = 1)", part("verdict", "reduced_chi2"), "{:.3f}".format),
        row("levels", lambda run: len(run.record["levels"]), str),
        row("exposures of the last level", last("groups"), count),
        row("of these, located", last("located"), count),
        row("change in the last level (px)", last("change_px"), pixels),
        row("panorama (px)", _size, str),
        row("seen share of the panorama", part("panorama", "coverage_share"), share),
        row("dynamic range (dB)", part("panorama", "dynamic_range_db"), "{:.0f}".format),
        row("time", lambda run: run.record["seconds"], duration),
        row("peak memory", lambda run: run.record["peak_memory_bytes"], byte_size),
    ]
    return [(name, [value or "\N{EN DASH}" for value in values]) for name, values in rows if any(values)]


def _size(run: ComparedRun) -> str | None:
    panorama = run.record["panorama"]
    return None if panorama is None else f"{panorama['width']} x {panorama['height']}"


def _differing(specs: Sequence[Mapping[str, Any]]) -> tuple[list[tuple[str, list[str]]], int]:
    """Return the settings in which specs differ, as a path and a text for each, and the number of those beyond the first."""
    flat = [dict(_flattened(spec)) for spec in specs]
    keys = list(dict.fromkeys(key for each in flat for key in each if not key.startswith("output.directory")))
    found = [(key, [each.get(key, "\N{EN DASH}") for each in flat]) for key in keys]
    differing = [(key, values) for key, values in found if len(set(values)) > 1]
    return differing[:_MOST_DIFFERENCES], max(0, len(differing) - _MOST_DIFFERENCES)


def _flattened(value: Any, path: str = "") -> list[tuple[str, str]]:
    if isinstance(value, Mapping):
        return [pair for key, each in value.items() for pair in _flattened(each, f"{path}.{key}" if path else str(key))]
    if isinstance(value, list | tuple) and any(isinstance(each, Mapping) for each in value):
        return [pair for number, each in enumerate(value, 1) for pair in _flattened(each, f"{path}[{number}]")]
    return [(path, flow(value))]


_COLOURS = {"trusted": "good", "done": "good", "doubtful": "bad", "failed": "bad", "interrupted": "bad"}


def render_batch(
    directory: Path,
    rows: Sequence[BatchRow],
    spec: str | Mapping[str, Any],
    common: Sequence[str],
    keys: Sequence[str],
) -> str:
    """Return the summary of a batch as one HTML page that needs no other file, no network and no script.

    The page lies in `directory`. `spec` is its text, or its data, `common` what was changed in it for all runs, and `keys` are
    the swept keys.
    """
    figures = {key: _errors_over_setting(rows, key, number) for number, key in enumerate(keys)}
    return filled(
        "batch.html",
        title=directory.name,
        version=importlib.metadata.version("photonpano"),
        created=datetime.now().astimezone().strftime("%d %B %Y, %H:%M %Z").strip(),
        rows=rows,
        failed=[row for row in rows if row.status == "failed"],
        numbers=Counter(row.verdict or row.status for row in rows),
        colours=_COLOURS,
        link_of=partial(_link_of_row, directory),
        columns={name: title for name, (title, _) in FIGURES.items() if any(getattr(row, name) is not None for row in rows)},
        pictures=any(row.thumbnail for row in rows),
        has_truth=any(row.true_error_px is not None or row.true_position_error is not None for row in rows),
        of_positions=any(row.expected_position_error is not None for row in rows),
        n_captures=len({row.name for row in rows}),
        n_coloured=_COLOURED,
        keys=keys,
        figures={key: figure for key, figure in figures.items() if figure},
        spec=spec if isinstance(spec, str) else yaml_of(spec),
        common=common,
    )


def _link_of_row(directory: Path, row: BatchRow) -> str | None:
    """Return the address of the report of a run, relative to the page; None if there is none."""
    return None if row.report is None else quote(os.fsencode(Path(os.path.relpath(row.report, directory)).as_posix()))


_COLOURED = len(SERIES)  # number of lines up to which each has a colour and a name
_ERRORS = {
    "true_error_px": "true error (px)",
    "expected_error_px": "expected error (px)",
    "true_position_error": "true error / path",
    "expected_position_error": "expected error / path",
}


def _errors_over_setting(rows: Sequence[BatchRow], key: str, number: int = 0) -> str | None:
    """Draw the errors of runs over a swept setting, a line for each capture and for what else is swept.

    Numbers are drawn to scale, other values at equal distances. None if no run that is done has an error.
    """
    errors = [name for name in _ERRORS if any(getattr(row, name) is not None for row in rows)]
    if not errors:
        return None
    places, names = _places([row.settings[key] for row in rows])
    with plain_figure(WIDTH_IN, 0.9 + 2.4 * len(errors)) as figure:
        panels = add_axes(figure, Margins(top=0.4), rows=[1] * len(errors), share_x=True)
        for axes, error in zip(panels, errors, strict=True):
            lines = _errors_by_series(rows, key, error, places)
            _draw(axes, lines)
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("{x:.2g}")
            axes.tick_params(axis="y", which="minor", size=0, labelsize=8)
            axes.set_ylabel(_ERRORS[error])
        panels[-1].set_xlabel(key)
        if names:
            panels[-1].set_xticks(range(len(names)), names)
        handles, labels = panels[0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="upper left", ncols=len(handles), handlelength=1.5, columnspacing=1.4)
        return svg_of(figure, f"errors-{number}")


def _places(values: Sequence[Any]) -> tuple[Mapping[str, float], list[str]]:
    """Return where on the axis each value stands, by its text, and the names of values that are no numbers."""
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return {written(value): float(value) for value in values}, []
    names = list(dict.fromkeys(written(value) for value in values))
    return {name: float(place) for place, name in enumerate(names)}, names


def _errors_by_series(
    rows: Sequence[BatchRow], key: str, error: str, places: Mapping[str, float]
) -> dict[str, tuple[list[float], list[float]]]:
    """Return the points of each line, ordered by x: the runs that differ in the swept setting only."""
    found: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        others = [f"{other}={written(value)}" for other, value in row.settings.items() if other != key]
        points = found.setdefault(", ".join([row.name, *others]), [])
        if (value := getattr(row, error)) is not None:
            points.append((places[written(row.settings[key])], value))
    ordered = {name: sorted(points) for name, points in found.items() if points}
    return {name: ([x for x, _ in points], [y for _, y in points]) for name, points in ordered.items()}


def _draw(axes: Axes, lines: Mapping[str, tuple[list[float], list[float]]]) -> None:
    if len(lines) <= _COLOURED:
        for (name, (x, y)), colour in zip(lines.items(), SERIES, strict=False):
            axes.plot(x, y, "o-", markersize=4, color=colour, label=name)
        return
    for x, y in lines.values():
        axes.plot(x, y, color=MUTED, linewidth=0.8, alpha=0.5)
    at = sorted({place for x, _ in lines.values() for place in x})
    medians = [np.median([y[x.index(place)] for x, y in lines.values() if place in x]) for place in at]
    axes.plot(at, medians, "o-", markersize=5, color=INK, linewidth=2.2, label="median")


@dataclass(frozen=True, slots=True)
class LiveFigures:
    """How far a run is that follows a capture."""

    # finishing: the capture is complete, and the whole of it is run
    state: Literal["waiting", "following", "finishing", "finished", "stopped"] = "waiting"
    frames: int = 0  # frames that have arrived
    promised: int | None = None  # frames that the capture will have; None if it does not say so
    shown: int = 0  # frames in the picture so far
    message: str = ""  # why the frames so far gave no panorama, or why the run has stopped; empty if nothing is wrong


def render_live(figures: LiveFigures, title: str, so_far: str, whole: str) -> str:
    """Return the page, which loads itself anew each second as long as the run goes on.

    `so_far` and `whole` are the addresses of the run folders of the frames so far, and of the whole capture.
    """
    # Another address each time, so that no browser shows an old picture.
    return filled("live.html", figures=figures, title=title, so_far=so_far, whole=whole, now=time_ns())
