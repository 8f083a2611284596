"""The files of a run that follows a capture: live.png, live.html, and live.json with the same figures."""

from __future__ import annotations

import json
import logging
import time
from dataclasses import asdict, replace
from pathlib import Path
from urllib.parse import quote

from photonpano.atomic import atomic_path
from photonpano.errors import OutputError
from photonpano.pipeline.following.picture import PictureSoFar
from photonpano.report import LiveFigures, render_live

logger = logging.getLogger(__name__)

PAGE, PICTURE, FIGURES = "live.html", "live.png", "live.json"


class LivePage:
    """Writes the page of a run, each file whole or not at all; it shows `figures`."""

    def __init__(self, folder: Path, run_folder: Path) -> None:
        """Remove the files of an earlier run from `folder`; the report will be in `run_folder`, beside it."""
        self.figures = LiveFigures()
        self._folder, self._run_folder = folder, run_folder
        self._failed = False
        self._remove()

    def write(self, figures: LiveFigures, picture: PictureSoFar | None = None) -> None:
        """Write the page, and the picture if it is given. If the disk is full, a warning says so: the run goes on."""
        self.figures = figures
        try:
            self._write(figures, picture)
        except OutputError as error:
            if not self._failed:
                logger.warning(f"the page of the run is not up to date: {error}")
            self._failed = True

    def _write(self, figures: LiveFigures, picture: PictureSoFar | None) -> None:
        if picture is not None and (png := picture.png()) is not None:
            self._replace(PICTURE, png)
        shown = None
        if (self._folder / PICTURE).exists():
            shown = f"{PICTURE}?{time.time_ns()}"  # another address, so that no browser shows an old picture
        page = render_live(figures, self._run_folder.name, shown, f"../{quote(self._run_folder.name)}/report.html")
        self._replace(PAGE, page.encode())
        self._replace(FIGURES, f"{json.dumps(asdict(figures), indent=2)}\n".encode())

    def end(self, reason: str, n_frames: int) -> None:
        """Say why the run has stopped after a number of frames; without any, there is no page."""
        if n_frames:
            self.write(replace(self.figures, state="stopped", frames=n_frames, message=reason))
        else:
            self._remove()

    def _remove(self) -> None:
        for name in (PAGE, PICTURE, FIGURES):
            (self._folder / name).unlink(missing_ok=True)

    def _replace(self, name: str, content: bytes) -> None:
        with atomic_path(self._folder / name, flushed=False) as temporary:
            temporary.write_bytes(content)
