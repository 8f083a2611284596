"""List the files of a run for its report: links, sizes, and what they hold."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import quote

from photonpano.record.contents import RECORD
from photonpano.record.schema import FileContent
from photonpano.text import counted

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
    "exposures/": "the exposures of each level, linear flux and pictures",
    RECORD: "the record: inputs, versions, choices and results",
}


@dataclass(frozen=True, slots=True)
class ListedFile:
    """A file of a run folder, or a folder in it.

    Attributes:
        name: its name; that of a folder ends in a slash.
        link: the same as a relative URL.
        bytes: its size, with all that a folder holds; None where it is not known yet.
        content: what it holds; empty where only its writer knows.
    """

    name: str
    link: str
    bytes: int | None
    content: str


def listed_files(files: Mapping[str, FileContent]) -> tuple[list[ListedFile], int]:
    """Return the first files and folders of a run, best known first, and the number of the others.

    A folder is one row: it may hold thousands of pictures.

    Args:
        files: as `run.json` lists them, which is listed as well.
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
