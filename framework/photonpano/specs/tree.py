"""A spec as it was written: plain values, each with the place where it stands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeAlias

from photonpano.errors import Problem

Scalar: TypeAlias = "str | int | float | bool | None"


@dataclass(frozen=True, slots=True)
class Place:
    """Where something of a spec stands.

    Attributes:
        where: path inside the spec, such as `levels.0.scale`; empty for the whole.
        file: the spec file, None for a spec that was built in Python.
        line: line in the file, from 1; None if unknown.
        column: column in the line, from 1; None if unknown.
        override: the override that set it, such as `run.seed=1`; None if it stands in the spec itself.
    """

    where: str = ""
    file: Path | None = None
    line: int | None = None
    column: int | None = None
    override: str | None = None

    def problem(self, message: str, key: str | int | None = None) -> Problem:
        """Make a problem of what stands here, or of one of its keys."""
        where = self.where if key is None else joined(self.where, key)
        return Problem(where, message, self.file, self.line, self.column, self.override)


@dataclass(slots=True)
class Value:
    """A value of a spec.

    Attributes:
        content: a scalar, a list of values, or a mapping to values.
        place: where the value starts.
        key: where its key starts; None for an item of a list and for the whole.
        readable: False if something else stood there, which has been reported.
    """

    content: Scalar | list[Value] | dict[str, Value]
    place: Place
    key: Place | None = None
    readable: bool = True

    @property
    def head(self) -> Place:
        """Where a reader looks for it first: its key, if it has one."""
        return self.key or self.place

    def plain(self) -> Any:
        """Return the bare data."""
        if isinstance(self.content, dict):
            return {key: value.plain() for key, value in self.content.items()}
        if isinstance(self.content, list):
            return [value.plain() for value in self.content]
        return self.content

    def walk(self) -> Iterator[Value]:
        """Yield this value and all values in it."""
        yield self
        if isinstance(self.content, dict | list):
            for child in self.content.values() if isinstance(self.content, dict) else self.content:
                yield from child.walk()

    def places(self) -> dict[str, Place]:
        """Return where to look for every value, by its path inside the spec."""
        return {value.place.where: value.head for value in self.walk()}

    def unreadable(self) -> list[str]:
        """Return the paths at which something stood that could not be read."""
        return [value.place.where for value in self.walk() if not value.readable]


def joined(where: str, key: str | int) -> str:
    """Return the path of a key: lists count from 0."""
    return f"{where}.{key}" if where else str(key)


def from_data(data: object, problems: list[Problem], place: Place) -> Value:
    """Turn plain Python data into values; what is no plain data becomes a problem and null."""
    match data:
        case None | bool() | str():
            return Value(data, place)
        case Integral():
            return Value(int(data), place)
        case Real():
            return Value(float(data), place)
        case Path():
            return Value(str(data), place)
        case list() | tuple():
            items = [from_data(item, problems, Place(joined(place.where, index))) for index, item in enumerate(data)]
            return Value(items, place)
        case Mapping():
            content: dict[str, Value] = {}
            for key, item in data.items():
                if isinstance(key, str):
                    content[key] = from_data(item, problems, Place(joined(place.where, key)))
                else:
                    problems.append(place.problem(f"a key is text, got {key!r}"))
            return Value(content, place)
    problems.append(place.problem(f"expected plain data (text, numbers, lists, mappings), got a {type(data).__name__}"))
    return Value(None, place, readable=False)


def given(content: object) -> str:
    """Say what stands there, for the end of a message."""
    match content:
        case None:
            return "nothing"
        case bool():
            return "true" if content else "false"
        case str():
            return repr(content) if len(content) <= 60 else f"{content[:57]!r}..."
        case list():
            return f"a list of {len(content)}" if content else "an empty list"
        case dict():
            return "a mapping"
    return str(content)
