"""Show a finished run in a notebook: its picture, its verdict, and where its files are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path

from photonpano.errors import InputError
from photonpano.notebooks import facts, from_here, picture_of_png
from photonpano.record.run_json import verdict_of
from photonpano.record.schema import RunRecord
from photonpano.report.drawing import shrunk
from photonpano.text import counted, duration, pixels, share

_MAX_PIXELS = 900  # longer side of the picture


class ShownReport:
    """A report that a notebook shows as a page in a frame."""

    def __init__(self, path: Path, height_px: int) -> None:
        """Read the report; `InputError` if there is none."""
        if not path.is_file():
            raise InputError(f"{path} does not exist; the run was rendered without a report, or its folder is gone")
        self._page, self._height_px = path.read_text(encoding="utf-8"), height_px

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{self._height_px}px;border:0"
        return f'<iframe title="report" style="{style}" srcdoc="{escape(self._page)}"></iframe>'


def run_html(folder: Path, record: RunRecord, own: Iterable[tuple[str, str]] = ()) -> str:
    """Return what a notebook shows of a run, with rows of its `own`; a picture that is no longer there is left out."""
    return _picture(folder / "panorama.png") + facts(_rows(record, from_here(folder), own))


def _picture(path: Path) -> str:
    """Return the picture of a run, made smaller; nothing if it cannot be read."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.exists() else None
    if image is None:
        return ""
    _, png = cv2.imencode(".png", shrunk(image, _MAX_PIXELS))
    return picture_of_png(png.tobytes(), "the panorama")


def _rows(record: RunRecord, place: Path, own: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    source, panorama, verdict = record["source"], record["panorama"], record["verdict"]
    motion = record["motion"]
    frames = counted(source["n_frames"], "frame")
    if verdict is not None:
        judged = verdict_of(verdict)
        yield "verdict", judged.status
        for reason in judged.reasons:
            yield "doubtful", str(reason)
    for warning in record["warnings"]:
        yield "warning", warning
    yield "capture", f"{frames} of {source['height']}x{source['width']} px"
    if panorama is not None:
        seen = share(panorama["coverage_share"])
        yield "panorama", f"{panorama['height']}x{panorama['width']} px, of which {seen} were seen"
    if motion is not None:
        yield "expected error", f"{pixels(motion['std_px'])} px, and {pixels(motion['worst_std_px'])} px in the worst frame"
    yield from own
    yield "time", duration(record["seconds"])
    yield "run folder", str(place)
    if "report.html" in record["files"]:
        yield "report", str(place / "report.html")
