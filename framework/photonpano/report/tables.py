"""Tables of a report: the files of the run, and the pairs that were not located by their reason."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypedDict
from urllib.parse import quote

from photonpano.record.contents import RECORD
from photonpano.record.schema import FailureRecord, FileContent, LevelRecord
from photonpano.text import counted

MAX_FILES = 30  # number of files that are listed

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
    """A file of a run folder, or a folder in it, whose name ends in a slash.

    Attributes:
        bytes: its size, with all that a folder holds; None where it is not known yet.
        content: what it holds; empty where only its writer knows.
    """

    name: str
    link: str
    bytes: int | None
    content: str


def listed_files(files: Mapping[str, FileContent]) -> tuple[list[ListedFile], int]:
    """Return the first files and folders of a run, best known first, and the number of the others.

    A folder is one row: it may hold thousands of pictures. run.json, which does not list itself, is added.
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


MAX_EXAMPLES = 3  # number of pairs of a group that are listed


class FailedLevel(TypedDict):
    """The pairs of a level that were not located."""

    level: int
    failures: Sequence[FailureRecord]


@dataclass(frozen=True, slots=True)
class FailureGroup:
    """Pairs of one level, in order, that failed for the same reason, apart from the numbers in it."""

    level: int
    failures: tuple[FailureRecord, ...]

    @property
    def reason(self) -> str:
        """The reason of the first pair, with its numbers."""
        return self.failures[0]["reason"]

    @property
    def alike(self) -> bool:
        """Whether all pairs have the same reason, numbers included."""
        return len({failure["reason"] for failure in self.failures}) == 1

    @property
    def examples(self) -> tuple[FailureRecord, ...]:
        """The first pairs."""
        return self.failures[:MAX_EXAMPLES]

    @property
    def more(self) -> int:
        """Number of pairs that are not among the examples."""
        return len(self.failures) - len(self.examples)


def failure_groups(levels: Sequence[LevelRecord | FailedLevel]) -> list[FailureGroup]:
    """Group the failures of each level by reason, the largest groups first."""
    groups = []
    for level in levels:
        alike: dict[str, list[FailureRecord]] = {}
        for failure in level["failures"]:
            alike.setdefault(re.sub(r"[-+]?\d+(\.\d+)?", "#", failure["reason"]), []).append(failure)
        by_size = sorted(alike.values(), key=len, reverse=True)
        groups += [FailureGroup(level["level"], tuple(failures)) for failures in by_size]
    return groups
