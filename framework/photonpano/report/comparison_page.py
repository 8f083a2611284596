"""Render the page that lays runs of one capture side by side."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from photonpano.plugins.registry.description import flow
from photonpano.record.schema import RunRecord
from photonpano.report.drawing import (
    INK,
    SERIES,
    WIDTH_IN,
    Margins,
    add_axes,
    jpeg_uri,
    mark_frames,
    mark_logarithmic,
    plain_figure,
    svg_of,
)
from photonpano.report.environment import filled
from photonpano.report.figures import instants_of
from photonpano.text import byte_size, count, duration, pixels, share
from photonpano.values import FloatArray

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
        links=[_link(run.folder, output) for run in runs],
        pictures=[jpeg_uri(run.picture) for run in runs],
        rows=_rows(runs),
        settings=shown,
        more_settings=hidden,
        differences=differences_over_time(runs) if any(run.mean_difference_px for run in runs) else None,
    )


def differences_over_time(runs: Sequence[ComparedRun]) -> str:
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


def _link(folder: Path, output: Path) -> str:
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
    return None if panorama is None else f"{panorama['height']}x{panorama['width']}"


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
