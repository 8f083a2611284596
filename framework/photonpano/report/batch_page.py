"""Render the summary of a batch as an HTML page."""

from __future__ import annotations

import importlib.metadata
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from photonpano.record.batch_row import FIGURES, BatchRow, written
from photonpano.report.drawing import INK, MUTED, SERIES, WIDTH_IN, Margins, add_axes, plain_figure, svg_of
from photonpano.report.environment import filled, yaml_of

if TYPE_CHECKING:  # importing matplotlib takes a second
    from matplotlib.axes import Axes


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
    figures = {key: errors_over_setting(rows, key, number) for number, key in enumerate(keys)}
    return filled(
        "batch.html",
        title=directory.name,
        version=importlib.metadata.version("photonpano"),
        created=datetime.now().astimezone().strftime("%d %B %Y, %H:%M %Z").strip(),
        rows=rows,
        failed=[row for row in rows if row.status == "failed"],
        numbers=Counter(row.verdict or row.status for row in rows),
        colours=_COLOURS,
        link_of=partial(_link, directory),
        columns={name: title for name, (title, _) in FIGURES.items() if any(getattr(row, name) is not None for row in rows)},
        pictures=any(row.thumbnail for row in rows),
        has_truth=any(row.true_error_px is not None or row.true_position_error is not None for row in rows),
        of_positions=any(row.expected_position_error is not None for row in rows),
        n_captures=len({row.name for row in rows}),
        n_coloured=COLOURED,
        keys=keys,
        figures={key: figure for key, figure in figures.items() if figure},
        spec=spec if isinstance(spec, str) else yaml_of(spec),
        common=common,
    )


def _link(directory: Path, row: BatchRow) -> str | None:
    """Return the address of the report of a run, relative to the page; None if there is none."""
    return None if row.report is None else quote(os.fsencode(Path(os.path.relpath(row.report, directory)).as_posix()))


COLOURED = len(SERIES)  # number of lines up to which each has a colour and a name
_ERRORS = {
    "true_error_px": "true error (px)",
    "expected_error_px": "expected error (px)",
    "true_position_error": "true error / path",
    "expected_position_error": "expected error / path",
}


def errors_over_setting(rows: Sequence[BatchRow], key: str, number: int = 0) -> str | None:
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
            lines = _lines(rows, key, error, places)
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


def _lines(
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
    if len(lines) <= COLOURED:
        for (name, (x, y)), colour in zip(lines.items(), SERIES, strict=False):
            axes.plot(x, y, "o-", markersize=4, color=colour, label=name)
        return
    for x, y in lines.values():
        axes.plot(x, y, color=MUTED, linewidth=0.8, alpha=0.5)
    at = sorted({place for x, _ in lines.values() for place in x})
    medians = [np.median([y[x.index(place)] for x, y in lines.values() if place in x]) for place in at]
    axes.plot(at, medians, "o-", markersize=5, color=INK, linewidth=2.2, label="median")
