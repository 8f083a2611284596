"""The jobs of a batch: one for each capture and each value of a swept key."""

from __future__ import annotations

import glob
import hashlib
import itertools
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photonpano.errors import InputError, Problem, SpecError
from photonpano.files.paths import Location, Url, as_written, given_path, location, refusal
from photonpano.plugins.registry import Catalog
from photonpano.record.batch_row import BatchRow, written
from photonpano.record.contents import RECORD
from photonpano.specs import Plan, parse_spec
from photonpano.specs.builtin import known_endings
from photonpano.specs.yaml_reader import Place, read_yaml

_TRUTH = ".truth.npz"
_COMPRESSED = (".gz",)
_LONGEST_LIST = 2**24  # maximum size of a list, in bytes; a larger file is probably a capture
CAPTURE_KEY, OUTPUT_KEY = "source.with.path", "output.directory"
_LONGEST_NAME = 120  # maximum length of the settings in the name of a folder; file systems allow 255 bytes
_UNSAFE = re.compile(r"[^\w.,=+\-]")


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
    endings = known_endings(catalog)
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


def _captures_at(text: str, folder: Path, endings: Sequence[str], is_capture: Callable[[Path], bool]) -> Sequence[Location]:
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


def _captures_in(folder: Path, endings: Sequence[str], is_capture: Callable[[Path], bool]) -> list[Path]:
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


@dataclass(frozen=True, slots=True)
class SpecText:
    """A spec as it was when the batch began: a file that is edited meanwhile does not change the runs to come.

    Relative paths count from `directory`; `file` is None for plain data.
    """

    content: str | Mapping[str, Any]
    directory: Path
    file: Path | None = None

    def plan(self, overrides: Sequence[str], output: Path, catalog: Catalog | None = None) -> Plan:
        """Resolve the spec with overrides; `SpecError` if it is wrong."""
        name = self.file.stem if self.file else "spec"
        return parse_spec(
            self.content,
            directory=self.directory,
            name=name,
            overrides=overrides,
            output=output,
            catalog=catalog,
            file=self.file,
        )


@dataclass(frozen=True, slots=True)
class Job:
    """What a process needs to do one run of a batch; it can be pickled. `threads` counts if the spec leaves that open."""

    row: BatchRow
    spec: SpecText
    overrides: tuple[str, ...]
    threads: int
    overwrite: bool = False


def is_of_capture(where: str) -> bool:
    """Return whether a problem of a spec, by its path there, concerns the capture."""
    return where in ("source", CAPTURE_KEY)


def capture_override(capture: Location) -> str:
    """Return the override that replaces the capture of the spec."""
    return override(CAPTURE_KEY, as_written(capture if isinstance(capture, Url) else capture.absolute()))


def override(key: str, value: Any) -> str:
    """Return an override that sets a key to a value; JSON is YAML."""
    return f"{key}={json.dumps(value, ensure_ascii=False)}"


def read_changes(
    changes: Iterable[str], swept: Iterable[str], takes_list: Callable[[str, str], bool]
) -> tuple[list[str], dict[str, list[Any]]]:
    """Separate the overrides for all runs from the values of each swept key.

    Args:
        changes: overrides such as `run.seed=1`. A list sweeps, as in `levels.0.scale=[0.5, 1]`, where the key takes no list.
        swept: such as `resample.with.group_size=50,100`; with brackets or without.
        takes_list: returns whether a key, given with its override, takes the list.

    Raises:
        SpecError: with all problems.
    """
    common: list[str] = []
    found: dict[str, list[Any]] = {}
    problems: list[Problem] = []
    for text, is_sweep in [*((each, False) for each in changes), *((each, True) for each in swept)]:
        key, sign, yaml = text.partition("=")
        key = key.strip()
        place = Place(where=key, override=text)
        if not sign or not all(key.split(".")):
            problems.append(Place(override=text).problem("expected KEY=VALUE, such as run.seed=1"))
            continue
        if key in (CAPTURE_KEY, OUTPUT_KEY):
            what = "the captures of a batch" if key == CAPTURE_KEY else "the folder of a batch"
            problems.append(place.problem(f"{what} are given beside the spec" if key == CAPTURE_KEY else f"{what} is --output"))
            continue
        unread: list[Problem] = []
        read = read_yaml(f"[{yaml}]" if is_sweep else yaml, place, unread).plain()
        if is_sweep and unread:
            problems += unread
        elif is_sweep or (isinstance(read, list) and read and not takes_list(key, text)):
            values = read[0] if is_sweep and len(read) == 1 and isinstance(read[0], list) else read
            unique = list({json.dumps(value): value for value in values}.values())
            if key in found:
                problems.append(place.problem("is swept twice; give all of its values at once"))
            elif not unique:
                problems.append(place.problem("expected values with commas between them, such as 50,100,200"))
            found.setdefault(key, unique)
        else:
            common.append(text)
    if problems:
        raise SpecError(problems)
    return common, found


def combinations(swept: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Return every combination of the values of swept keys; one without any if nothing is swept."""
    return [dict(zip(swept, values, strict=True)) for values in itertools.product(*swept.values())]


def folder_name(capture: str, settings: Mapping[str, Any]) -> str:
    """Return the name of a run folder: that of the capture, and its settings, as in `night,levels=2,run.seed=1`.

    Settings that are long, or hold characters that file systems or shells do not take, are shortened and end in a hash.
    """
    text = ",".join(f"{key}={written(value)}" for key, value in settings.items())
    safe = _UNSAFE.sub("_", text)
    if safe != text or len(text) > _LONGEST_NAME:
        safe = f"{safe[:_LONGEST_NAME]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    return f"{capture},{safe}" if settings else capture
