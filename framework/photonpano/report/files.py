"""List the files of a run for its report: links, sizes, and what they hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import quote

from photonpano.record.contents import RECORD
from photonpano.record.schema import FileContent

MAX_FILES = 30
"""Number of files that are listed."""

_CONTENTS = {
    "panorama.tiff": "linear flux in photons per pixel per frame, float32; NaN where nothing was seen",
    "panorama.png": "the panorama to look at, 8 bits",
    "coverage.tiff": "the number of frames that saw each pixel of the panorama, float32",
    "trajectory.npz": "the motion of every frame",
    "light.npz": "the gain of the light in each frame",
    "vignette.npz": "the relative sensitivity of each pixel",
    "panorama.exr": "linear flux, for programs that work with a large range",
    "panorama.hdr": "linear flux, for programs that work with a large range",
    RECORD: "the record: inputs, versions, choices and results",
}


@dataclass(frozen=True, slots=True)
class ListedFile:
    """A file of a run folder.

    Attributes:
        name: its path in the folder.
        link: the same as a relative URL.
        bytes: its size; None where it is not known yet.
        content: what it holds; empty where only its writer knows.
    """

    name: str
    link: str
    bytes: int | None
    content: str


def listed_files(files: Mapping[str, FileContent]) -> tuple[list[ListedFile], int]:
    """Return the first files of a run, best known first, and the number of the others.

    Args:
        files: as `run.json` lists them, which is listed as well.
    """
    order = {name: place for place, name in enumerate(_CONTENTS)}
    names = sorted({*files, RECORD} - {"report.html"}, key=lambda name: (order.get(name, len(order)), name))
    listed = [
        ListedFile(name, quote(f"./{name}"), files[name]["bytes"] if name in files else None, _CONTENTS.get(name, ""))
        for name in names[:MAX_FILES]
    ]
    return listed, len(names) - len(listed)
