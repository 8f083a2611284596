"""Write the summary of a batch, `summary.csv` and `summary.html`, whenever it changes."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from photonpano.errors import OutputError
from photonpano.files.atomic import atomic_path
from photonpano.record.batch_row import FIGURES, BatchRow, ranked, written
from photonpano.report import render_batch

TABLE, PAGE = "summary.csv", "summary.html"
_FIRST = ("name", "capture", "run", "status", "verdict")


def write_summary(
    directory: Path,
    rows: Sequence[BatchRow],
    spec: str | Mapping[str, Any],
    common: Sequence[str],
    keys: Sequence[str],
) -> None:
    """Write both files, each whole or not at all, with the runs `ranked`; for the arguments, see `render_batch`."""
    rows = ranked(rows)
    page = render_batch(directory, rows, spec, common, keys)
    for name, text in ((TABLE, _table(directory, rows, keys)), (PAGE, page)):
        with atomic_path(directory / name, flushed=False) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


def require_own(directory: Path) -> None:
    """Raise `OutputError` if the folder holds a summary that no batch has written."""
    path = directory / TABLE
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            own = file.readline().startswith(",".join(_FIRST))
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return
    except OSError as error:
        raise OutputError(f"{path} cannot be read ({error.strerror}); choose another folder with --output") from error
    if not own:
        raise OutputError(f"{path} is no summary of a batch, and would be replaced; choose another folder with --output")


def _table(directory: Path, rows: Sequence[BatchRow], keys: Sequence[str]) -> str:
    """Return the table in CSV: empty where a run has no such figure."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_FIRST, *keys, *FIGURES, "reason"])
    for row in rows:
        first = [row.name, str(row.capture), row.directory.relative_to(directory).as_posix(), row.status, row.verdict]
        settings = [written(row.settings[key]) for key in keys]
        writer.writerow([*first, *settings, *(getattr(row, name) for name in FIGURES), row.reason])
    return text.getvalue()
