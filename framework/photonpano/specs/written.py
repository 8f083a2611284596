"""A spec as it was written: plain data, and a table of the place of each value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from photonpano.errors import Problem
from photonpano.paths import Url
from photonpano.registry.catalog import Catalog
from photonpano.text import listed, suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from photonpano.values import Decision


@dataclass(frozen=True, slots=True)
class Place:
    """Where a value of a spec was written.

    Attributes:
        where: path inside the spec, such as `levels.0.scale`; empty for the whole.
        file: the spec file, None for a spec that was built in Python.
        line: line of the key (of the value, if it has no key) in the file, from 1; None if unknown.
        column: column of the key in the line, from 1; None if unknown.
        override: the override that set the value, such as `run.seed=1`; None if it stands in the spec itself.
        start: line and column of the value, if it has a key.
    """

    where: str = ""
    file: Path | None = None
    line: int | None = None
    column: int | None = None
    override: str | None = None
    start: tuple[int, int] | None = None

    def problem(self, message: str) -> Problem:
        """Return a problem with the key, or with the value that has none."""
        return Problem(self.where, message, self.file, self.line, self.column, self.override)


@dataclass
class WrittenSpec:
    """A spec while it is resolved.

    Attributes:
        data: plain data: text, numbers, lists, mappings.
        places: the place of each value, by its path. A value that moves while the spec is resolved, such as a locator of a
            chain that becomes a fallback, has an entry for its new path with the place where it was written.
        problems: what is wrong, so far.
        unreadable: the paths of values that could not be read; no further problem with them is reported.
        sections_of: the sections in which a key may stand, such as `resample.with` for `group_size`; "" for a section itself.
        remark: added to the message of every problem.
        arriving: whether the capture is still being written, so that its files are not checked.
        directory: what relative paths count from.
        catalog: what can be chosen.
        decisions: choices that the spec leaves open and that reading it made.
    """

    data: Any
    places: dict[str, Place]
    problems: list[Problem] = field(default_factory=list)
    directory: Path = Path()
    catalog: Catalog = field(default_factory=Catalog)
    unreadable: set[str] = field(default_factory=set)
    decisions: list[Decision] = field(default_factory=list)
    sections_of: dict[str, list[str]] = field(default_factory=dict)
    remark: str = ""
    arriving: bool = False

    def place(self, where: str) -> Place:
        """Return the place of a value; if it was not written, that of the mapping or list where it would stand."""
        return place_of(self.places, where)

    def wrong(self, where: str, message: str) -> None:
        """Report a problem with a value."""
        place = self.place(where)
        line, column = place.start or (place.line, place.column)
        self.problems.append(replace(place, line=line, column=column).problem(message + self.remark))

    def wrong_key(self, where: str, message: str) -> None:
        """Report a problem with a key: one that is unknown, or missing."""
        self.problems.append(self.place(where).problem(message + self.remark))

    def places_under(self, source: str, target: str) -> dict[str, Place]:
        """Return the places of a value and all values in it, by the paths that they have once the value has moved."""
        inside = {path: place for path, place in self.places.items() if f"{path}.".startswith(f"{source}.")}
        return {target + path.removeprefix(source): place for path, place in inside.items()}

    def replace_places(self, where: str, places: Mapping[str, Place]) -> None:
        """Forget the places of a value and all values in it, and enter others."""
        for path in [path for path in self.places if path == where or path.startswith(f"{where}.")]:
            del self.places[path]
        self.places.update(places)

    def mapping(self, data: Any, where: str, example: str = "") -> dict[str, Any] | None:
        """Return a section, where nothing counts as an empty mapping; anything but a mapping is a problem, and None."""
        if data is None:
            return {}
        if isinstance(data, dict):
            return data
        self.wrong(where, f"expected a mapping{example}, got {given(data)}")
        return None

    def check_keys(self, section: Mapping[str, Any], where: str, known: Iterable[str], below: Iterable[str] = ()) -> None:
        """Report unknown keys.

        Args:
            section: a mapping.
            where: its path.
            known: the keys that it may have.
            below: the keys that the mapping under its `with` may have.
        """
        for key in section:
            if key not in known:
                message = "unknown key; it belongs under `with`" if key in below else self.unknown_key(key, where, known)
                self.wrong_key(joined(where, key), message)

    def unknown_key(self, key: str, where: str, known: Iterable[str]) -> str:
        """Return the message for an unknown key: where it belongs, else the nearest of the keys that are known."""
        _, *inside_level = where.split(".", 2) if where.startswith("levels.") else ("", "", where)
        sections = [f"`{section}`" for section in self.sections_of.get(key, ()) if section != inside_level[-1]]
        if "" in self.sections_of.get(key, ()):
            return f"unknown key; `{key}` is a section of its own, not part of another"
        if sections:
            return f"unknown key; it belongs under {listed(sections, 'or')}"
        return f"unknown key; {suggestion(key, known) or 'no keys are allowed here'}"


def place_of(places: Mapping[str, Place], where: str) -> Place:
    """Return the place of a value; if it was not written, that of the mapping or list where it would stand."""
    if where in places or not where:
        return places.get(where, Place())
    parent, _, key = where.rpartition(".")
    above = place_of(places, parent)
    return replace(above, where=joined(above.where, key), start=None)


def joined(where: str, key: str | int) -> str:
    """Return the path of a key or an item; items count from 0."""
    return f"{where}.{key}" if where else str(key)


def given(data: object) -> str:
    """Describe a value, for the end of a message."""
    match data:
        case None:
            return "nothing"
        case bool():
            return "true" if data else "false"
        case str():
            return repr(data) if len(data) <= 60 else f"{data[:57]!r}..."
        case list():
            return f"a list of {len(data)}" if data else "an empty list"
        case dict():
            return "a mapping"
    text = str(data)
    return text if len(text) <= 60 else f"{text[:57]}..."


def from_python(data: object, place: Place) -> WrittenSpec:
    """Read a spec from Python data; anything but plain data becomes a problem and None."""
    spec = WrittenSpec(None, {"": place})
    try:
        spec.data = _plain(data, "", spec)
    except RecursionError:
        spec.problems.append(place.problem("not a spec: nested too deeply"))
    return spec


def _plain(data: object, where: str, spec: WrittenSpec) -> Any:
    match data:
        case str() if any("\ud800" <= each <= "\udfff" for each in data):
            spec.wrong(where, f"{data!a} is no text of UTF-8, which results cannot record; if it names a file, rename it")
            spec.unreadable.add(where)
            return None
        case None | bool() | str():
            return data
        case Integral():
            return int(data)
        case Real():
            return float(data)
        case Path():
            return _plain(str(data), where, spec)
        case Url():
            return _plain(data.address, where, spec)
        case list() | tuple():
            return [_plain(item, joined(where, index), spec) for index, item in enumerate(data)]
        case Mapping():
            content = {}
            for key, item in data.items():
                if isinstance(key, str):
                    content[key] = _plain(item, joined(where, key), spec)
                else:
                    spec.wrong(where, f"a key is text, got {key!r}")
            return content
    spec.wrong(where, f"expected plain data (text, numbers, lists, mappings), got a {type(data).__name__}")
    spec.unreadable.add(where)
    return None
