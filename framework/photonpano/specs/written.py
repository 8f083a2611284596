"""Values of a spec, each with the place where it was written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from photonpano.errors import Problem
from photonpano.files.paths import Url


@dataclass(frozen=True, slots=True)
class Place:
    """Where a value of a spec was written, or would be."""

    where: str = ""  # path inside the spec, such as `levels.0.scale`; empty for the whole
    file: Path | None = None  # the spec file, None for a spec that was built in Python
    line: int | None = None  # line of the key (of the value, if it has no key) in the file, from 1; None if unknown
    column: int | None = None  # column of the key in the line, from 1; None if unknown
    override: str | None = None  # the override that set the value, such as `run.seed=1`; None if it stands in the spec itself
    start: tuple[int, int] | None = None  # line and column of the value, if it has a key
    # whether a value stands here; if not, line and column are those of the mapping or list where it would stand
    is_written: bool = True
    is_readable: bool = True  # whether what stands here, or around it, could be read; if not, that is the only problem with it

    def problem(self, message: str) -> Problem:
        """Return a problem with the key, or with the value that has none."""
        return Problem(self.where, message, self.file, self.line, self.column, self.override)

    def below(self, key: str | int) -> Place:
        """Return the place of a key or an item that is not written."""
        return replace(self, where=joined(self.where, key), start=None, is_written=False)


@dataclass(frozen=True, slots=True)
class Written:
    """A value of a spec: text, a number, true, false, nothing, a list of such values, or a mapping.

    It keeps its place wherever it is used: a locator of a chain that becomes a fallback is reported as part of the chain.
    """

    data: Any
    place: Place = Place()

    def at(self, *keys: str | int) -> Written:
        """Return a value in this one, by keys and indices; nothing, with the place where it would stand, if there is none."""
        found = self
        for key in keys:
            match found.data:
                case dict() if key in found.data:
                    found = found.data[key]
                case list() if str(key).isdecimal() and int(key) < len(found.data):
                    found = found.data[int(key)]
                case _:
                    found = Written(None, found.place.below(key))
        return found

    def only(self, keys: Iterable[str]) -> Written:
        """Return a mapping without any other keys; anything else stays as it is."""
        if not isinstance(self.data, dict):
            return self
        return Written({key: self.data[key] for key in self.data if key in keys}, self.place)

    def without(self, *keys: str) -> Written:
        """Return a mapping without some keys; anything else stays as it is."""
        return self.only(self.data.keys() - {*keys}) if isinstance(self.data, dict) else self

    def having(self, values: Mapping[str, Written]) -> Written:
        """Return a mapping with some values added or replaced; nothing counts as an empty mapping."""
        return Written({**(self.data or {}), **values}, self.place)

    def laid_over(self, base: Written) -> Written:
        """Return these keys of a mapping with those of another that they leave out; if nothing is written, the other."""
        if isinstance(self.data, dict) and isinstance(base.data, dict):
            return Written(base.data | self.data, self.place)
        return base if self.data is None else self

    def items(self) -> list[Written]:
        """Return the values of a list; anything else is a list of one, and nothing an empty one."""
        if isinstance(self.data, list):
            return self.data
        return [] if self.data is None else [self]

    def spelled_out(self, key: str = "use") -> Written:
        """Return the mapping for which a word stands: of one key, such as the name of a component; else the value itself."""
        return Written({key: self}, self.place) if isinstance(self.data, str) else self

    def plain(self) -> Any:
        """Return the value as plain data, without places."""
        match self.data:
            case dict():
                return {key: item.plain() for key, item in self.data.items()}
            case list():
                return [item.plain() for item in self.data]
        return self.data

    def all(self) -> Iterator[Written]:
        """Yield this value and all values in it."""
        yield self
        inside = self.data.values() if isinstance(self.data, dict) else self.data if isinstance(self.data, list) else ()
        for item in inside:
            yield from item.all()


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


def from_python(data: object, place: Place, problems: list[Problem]) -> Written:
    """Read plain Python data, all of it on the line of its place; anything else is a problem, and nothing in its place."""
    try:
        return _from_python(data, place, problems)
    except RecursionError:
        problems.append(place.problem("not a spec: nested too deeply"))
        return Written(None, place)


def _from_python(data: object, place: Place, problems: list[Problem]) -> Written:
    match data:
        case str() if any("\ud800" <= each <= "\udfff" for each in data):
            message = f"{data!a} is no text of UTF-8, which results cannot record; if it names a file, rename it"
        case None | bool() | str():
            return Written(data, place)
        case Integral():
            return Written(int(data), place)
        case Real():
            return Written(float(data), place)
        case Path():
            return _from_python(str(data), place, problems)
        case Url():
            return Written(data.address, place)
        case list() | tuple():
            return Written([_from_python(item, _inside(place, index), problems) for index, item in enumerate(data)], place)
        case Mapping():
            content = {}
            for key, item in data.items():
                if isinstance(key, str):
                    content[key] = _from_python(item, _inside(place, key), problems)
                else:
                    problems.append(place.problem(f"a key is text, got {key!r}"))
            return Written(content, place)
        case _:
            message = f"expected plain data (text, numbers, lists, mappings), got a {type(data).__name__}"
    problems.append(place.problem(message))
    return Written(None, replace(place, is_readable=False))


def _inside(place: Place, key: str | int) -> Place:
    return replace(place, where=joined(place.where, key))
