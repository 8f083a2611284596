"""Find the captures of a batch: files, folders, URLs, patterns, and lists of them."""

from __future__ import annotations

import glob
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from photonpano.errors import InputError
from photonpano.files.paths import Location, Url, given_path, location, refusal
from photonpano.plugins.contributions import SourceContribution
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import RECORD

_TRUTH = ".truth.npz"
_COMPRESSED = (".gz",)
_LONGEST_LIST = 2**24  # maximum size of a list, in bytes; a larger file is probably a capture


def find_captures(
    given: Iterable[str | Path], lists: Iterable[str | Path], catalog: Catalog, is_capture: Callable[[Path], bool]
) -> dict[str, Location]:
    """Return captures by their names, each once, in the order in which they were given.

    A missing file counts as a capture: its run fails and says so, and the others go on.

    Args:
        given: files, folders and patterns such as `captures/*.npy`, relative to the current folder, and URLs. A folder that is
            no capture stands for the captures in it.
        lists: text files with one of these a line, relative to the folder of the list; empty lines, and those that begin with
            `#`, are left out. `-` is standard input, whose paths count from the current folder.
        catalog: the sources, whose files end as captures do.
        is_capture: returns whether the spec can read a folder, or a file in one.

    Raises:
        InputError: nothing is found in a place, a list cannot be read, two captures have one name, or there are none; the
            message has all problems, a line each.
    """
    found: dict[Location, Location] = {}
    problems: list[str] = []
    sources = [each.contribution for each in catalog.rows if isinstance(each.contribution, SourceContribution)]
    endings = {suffix for source in sources for suffix in source.suffixes}
    nothing_given = True
    for text, folder, where in _texts(given, lists, problems):
        nothing_given = False
        try:
            for place in _captures_at(text, folder, endings, is_capture):
                found.setdefault(place if isinstance(place, Url) else place.resolve(), place)
        except (InputError, ValueError, OSError) as error:
            problems.append(f"{where}{error}")
    if nothing_given and not problems:
        problems.append("no capture is given: name files, folders, or patterns in quotes such as 'captures/*.npy'")
    named: dict[str, Location] = {}
    for place in found.values():
        name = _name(place)
        if any("\ud800" <= each <= "\udfff" for each in str(place if isinstance(place, Url) else place.absolute())):
            problems.append(f"{str(place)!a} is no text of UTF-8, which results cannot record; rename it")
        if name in named:
            problems.append(
                f"two captures are called {name}, and would get one run folder: {named[name]} and {place}; rename one of them, "
                "or run them in two batches"
            )
        named.setdefault(name, place)
    if problems:
        raise InputError("\n".join(problems))
    return named


def _texts(given: Iterable[str | Path], lists: Iterable[str | Path], problems: list[str]) -> Iterator[tuple[str, Path, str]]:
    """Yield each argument that names captures, its base folder, and the prefix of messages about it."""
    for each in given:
        yield str(each), Path(), ""
    for each in lists:
        try:
            lines, folder = _lines(Path(each))
        except (InputError, ValueError) as error:
            problems.append(str(error))
            continue
        empty = True
        for number, line in enumerate(lines, start=1):
            text = line.strip()
            if text and not text.startswith("#"):
                empty = False
                yield text, folder, f"{each}:{number}: "
        if empty:
            problems.append(f"{each}: the list names no capture; write one a line")


def _lines(path: Path) -> tuple[Sequence[str], Path]:
    """Return the lines of a list, and its base folder."""
    if str(path) == "-":
        return sys.stdin.read().splitlines(), Path()
    path = given_path(path)
    if reason := refusal(path):
        raise InputError(reason)
    try:
        with path.open("rb") as file:
            data = file.read(_LONGEST_LIST + 1)
        if len(data) > _LONGEST_LIST or b"\0" in data:
            raise InputError(f"{path}: not a list of captures, which is text; name captures as arguments")
        return data.decode("utf-8-sig").splitlines(), path.parent
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: the list is not UTF-8 text; save it as UTF-8, one capture a line") from error
    except OSError as error:
        raise InputError(f"{path}: the list of captures cannot be read: {error.strerror}") from error


def _captures_at(text: str, folder: Path, endings: set[str], is_capture: Callable[[Path], bool]) -> Sequence[Location]:
    """Return the captures that a path, a URL, or a pattern stands for; `InputError` if there are none."""
    if isinstance(url := location(text), Url):
        if "*" in str(url):
            raise InputError(f"{url} is a pattern, and only files of this computer are matched; name each URL, as in a list")
        return [url]
    given = given_path(Path(text))
    path = folder / given
    if "\0" in text:
        raise InputError(f"{text!r} contains the character NUL, which no path can; correct the path")
    if path.is_dir():
        return _captures_in(path, endings, is_capture)
    if path.exists() or not glob.has_magic(text):
        return [path]
    matches = glob.glob(str(given), root_dir=folder, recursive=True)  # noqa: PTH207 - Path.glob finds hidden files as well
    captures = [each for each in sorted(folder / match for match in matches) if not _is_ours(each)]
    if not captures:
        raise InputError(f"nothing matches {text}; check the pattern")
    return captures


def _captures_in(folder: Path, endings: set[str], is_capture: Callable[[Path], bool]) -> list[Path]:
    """Return a folder that is a capture, or else the captures in it, and files that end as captures do."""
    if is_capture(folder):
        return [folder]
    found = [
        path
        for path in sorted(folder.iterdir())
        if not path.name.startswith(".")
        and not _is_ours(path)
        and ((path.is_file() and path.suffix.lower() in endings) or is_capture(path))
    ]
    if not found:
        raise InputError(f"{folder} is no capture that the spec can read, and there is none in it; name the files")
    return found


def _is_ours(path: Path) -> bool:
    """Return whether a path is a truth beside a capture, or a run folder."""
    return path.name.endswith(_TRUTH) or (path / RECORD).is_file()


def _name(place: Location) -> str:
    """Return the name of a capture: that of its folder, or of its file without the ending."""
    if isinstance(place, Url):
        whole = Path(place.name or place.host)
    else:
        whole = place.absolute()
        if place.is_dir():
            return Path(os.path.normpath(whole)).name  # a folder that is given as `..` has a name as well
    return Path(whole.stem).stem if whole.suffix in _COMPRESSED else whole.stem
