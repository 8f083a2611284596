"""Render the summary of a batch as an HTML page."""

from __future__ import annotations

import importlib.metadata
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from photonpano.record.batch_row import BatchRow
from photonpano.report.batch_figures import COLOURED, errors_over_setting
from photonpano.report.environment import environment_of, yaml_of
from photonpano.text import byte_size, count, duration, pixels

_COLOURS = {"trusted": "good", "done": "good", "doubtful": "bad", "failed": "bad", "interrupted": "bad"}


@dataclass(frozen=True, slots=True)
class _Column:
    """A column of figures, which is shown where a run has one."""

    title: str
    figure: str
    write: Callable[[Any], str]

    def written(self, row: BatchRow) -> str:
        """Return the figure of a run; a dash if it has none."""
        value = getattr(row, self.figure)
        return "\N{EN DASH}" if value is None else self.write(value)


def _percent(share: float) -> str:
    return f"{pixels(100 * share)} %"


_COLUMNS = (
    _Column("expected error", "expected_error_px", lambda value: f"{pixels(value)} px"),
    _Column("true error", "true_error_px", lambda value: f"{pixels(value)} px"),
    _Column("PSNR", "psnr_db", lambda value: f"{value:.1f} dB"),
    _Column("expected error", "expected_position_error", _percent),
    _Column("true error", "true_position_error", _percent),
    _Column("frames", "n_frames", count),
    _Column("time", "seconds", duration),
    _Column("peak memory", "peak_memory_bytes", byte_size),
)


def render_batch(
    directory: Path,
    rows: Sequence[BatchRow],
    spec: str | Mapping[str, Any],
    common: Sequence[str],
    keys: Sequence[str],
) -> str:
    """Return the summary of a batch as one HTML page that needs no other file, no network and no script.

    Args:
        directory: the folder of the page, from which it links to the reports of the runs.
        rows: all runs.
        spec: the text of the spec, or its data.
        common: what was changed in it for all runs.
        keys: the swept keys.
    """
    figures = {key: errors_over_setting(rows, key, number) for number, key in enumerate(keys)}
    page: str = (
        environment_of()
        .get_template("batch.html")
        .render(
            title=directory.name,
            version=importlib.metadata.version("photonpano"),
            created=datetime.now().astimezone().strftime("%d %B %Y, %H:%M %Z").strip(),
            rows=rows,
            failed=[row for row in rows if row.status == "failed"],
            numbers=Counter(row.verdict or row.status for row in rows),
            colours=_COLOURS,
            link_of=partial(_link, directory),
            columns=[each for each in _COLUMNS if any(getattr(row, each.figure) is not None for row in rows)],
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
    )
    return page


def _link(directory: Path, row: BatchRow) -> str | None:
    """Return the address of the report of a run, relative to the page; None if there is none."""
    return None if row.report is None else quote(os.fsencode(Path(os.path.relpath(row.report, directory)).as_posix()))
