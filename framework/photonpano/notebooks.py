"""Show values and progress in notebooks, as HTML. Without IPython nothing here is used; ipywidgets is not needed."""

from __future__ import annotations

import base64
import io
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.text import count, duration

_MAX_PIXELS = 900  # longer side of a picture
_WHITE_QUANTILE = 0.995
_PERIOD_S = 0.2  # least time between two drawings of the bars


def in_notebook() -> bool:
    """Return whether the program runs in the kernel of a notebook, which can show HTML."""
    if "ipykernel" not in sys.modules:
        return False
    from IPython.core.getipython import get_ipython

    return hasattr(get_ipython(), "kernel")


def facts(rows: Iterable[tuple[str, str]]) -> str:
    """Return a table of names and what they are, as HTML."""
    left = "text-align:left"
    cells = "".join(
        f'<tr><th style="{left};white-space:nowrap">{escape(name)}</th><td style="{left}">{escape(value)}</td></tr>'
        for name, value in rows
    )
    return f"<table>{cells}</table>"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table with a head, as HTML."""
    left = "text-align:left"
    titles = "".join(f'<th style="{left}">{escape(title)}</th>' for title in head)
    body = "".join("<tr>" + "".join(f'<td style="{left}">{escape(cell)}</td>' for cell in cells) + "</tr>" for cells in rows)
    return f"<table><tr>{titles}</tr>{body}</table>"


def from_here(path: Path) -> Path:
    """Return a path relative to the current folder where it lies in that, as people read it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def picture(image: NDArray[np.floating[Any]], alt: str) -> str:
    """Return a picture of an (H, W) or (H, W, 3) image, as HTML: values in square root, NaN black."""
    from PIL import Image

    known = image[np.isfinite(image)]
    white = float(np.quantile(known, _WHITE_QUANTILE)) if known.size else 0.0
    levels = np.sqrt(np.clip(np.nan_to_num(image) / (white or 1.0), 0, 1))
    shown = Image.fromarray(np.asarray(255 * levels + 0.5, np.uint8))
    shown.thumbnail((_MAX_PIXELS, _MAX_PIXELS))
    buffer = io.BytesIO()
    shown.save(buffer, "png")
    return picture_of_png(buffer.getvalue(), alt)


def picture_of_png(png: bytes, alt: str) -> str:
    """Return a picture that is given as the content of a PNG file, as HTML."""
    data = base64.b64encode(png).decode()
    return f'<img src="data:image/png;base64,{data}" alt="{escape(alt)}" style="max-width:100%">'


@dataclass
class _Bar:
    title: str
    total: int
    unit: str
    done: int = 0
    start: float = field(default_factory=time.monotonic)
    seconds: float | None = None

    def __str__(self) -> str:
        seconds = time.monotonic() - self.start if self.seconds is None else self.seconds
        return f"{self.title}: {count(self.done)} of {count(self.total)} {self.unit}, {duration(seconds)}"

    def html(self) -> str:
        title, _, rest = str(self).rpartition(": ")
        bar = f'<progress value="{self.done}" max="{max(self.total, 1)}"></progress>'
        return f'<tr><td style="text-align:left">{escape(title)}</td><td>{bar}</td><td>{escape(rest)}</td></tr>'


class NotebookBars:
    """Draws a bar for each stage below the cell; finished bars stay, with the time they took."""

    def __init__(self) -> None:
        self._rows: list[_Bar | str] = []
        self._lock = threading.Lock()
        self._handle: Any = None
        self._drawn = 0.0

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        """Draw the bar of a stage of `total` units."""
        bar = _Bar(title, total, unit)
        with self._lock:
            self._rows.append(bar)
            self._draw()

        def advance(done: int) -> None:
            with self._lock:
                bar.done += done
                if time.monotonic() > self._drawn + _PERIOD_S:
                    self._draw()

        try:
            yield advance
        finally:
            with self._lock:
                bar.seconds = time.monotonic() - bar.start
                self._draw()

    def note(self, message: str) -> None:
        """Write a line below the bars so far."""
        with self._lock:
            self._rows.append(message)
            self._draw()

    def _draw(self) -> None:
        from IPython.display import display

        # One output for all stages, which is replaced: nothing is left over, and nothing scrolls by.
        if self._handle is None:
            self._handle = display(self, display_id=True)
        else:
            self._handle.update(self)
        self._drawn = time.monotonic()

    def __repr__(self) -> str:
        return "\n".join(map(str, self._rows))

    def _repr_html_(self) -> str:
        rows = (
            row.html() if isinstance(row, _Bar) else f'<tr><td colspan="3" style="text-align:left">{escape(row)}</td></tr>'
            for row in self._rows
        )
        return f"<table>{''.join(rows)}</table>"
