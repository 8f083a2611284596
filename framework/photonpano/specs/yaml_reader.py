"""Read YAML into values with their places. Nothing is constructed from tags, so nothing in a file is executed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, StringMark, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode
from ruamel.yaml.reader import ReaderError

from photonpano.errors import Problem
from photonpano.files.paths import Url

TAG = "tag:yaml.org,2002:"
KNOWN = ("map", "seq", "null", "bool", "int", "float", "str", "timestamp", "value")  # dates are text
WHOLE = re.compile(r"[-+]?\d+[eE]\+?\d{1,2}")


@dataclass(frozen=True, slots=True, kw_only=True)
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
        return Problem(
            where=self.where, message=message, file=self.file, line=self.line, column=self.column, override=self.override
        )

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


_WITH_COMMAS = re.compile(r"\d{1,3}(,\d{3})+(\.\d*)?")


def given(data: object) -> str:
    """Describe a value, for the end of a message."""
    match data:
        case None:
            return "nothing"
        case bool():
            return "true" if data else "false"
        case str() if _WITH_COMMAS.fullmatch(data):
            return f"{data!r}; write numbers without commas"
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
            return from_python(str(data), place, problems)
        case Url():
            return Written(data.address, place)
        case list() | tuple():
            return Written([from_python(item, _inside(place, index), problems) for index, item in enumerate(data)], place)
        case Mapping():
            content = {}
            for key, item in data.items():
                if isinstance(key, str):
                    content[key] = from_python(item, _inside(place, key), problems)
                else:
                    problems.append(place.problem(f"a key is text, got {key!r}"))
            return Written(content, place)
        case _:
            message = f"expected plain data (text, numbers, lists, mappings), got a {type(data).__name__}"
    problems.append(place.problem(message))
    return Written(None, replace(place, is_readable=False))


def _inside(place: Place, key: str | int) -> Place:
    return replace(place, where=joined(place.where, key))


def read_yaml(text: str, place: Place, problems: list[Problem]) -> Written:
    """Read one YAML 1.2 document; aliases and merge keys are followed.

    Its values get lines and columns, unless the place is an override. What cannot be read is added to the problems; nothing is
    returned for a text that is not YAML, or without a document.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.composer.warn_double_anchors = False
    reader = _Reader(yaml, place, problems)
    try:
        node = yaml.compose(text)
        if node is not None:
            return reader.value(node, reader.place(node, place.where))
    except MarkedYAMLError as error:
        problems.append(_syntax_problem(error, reader))
    except ReaderError as error:
        if not place.override:
            line_start = text.rfind("\n", 0, error.position)
            place = replace(place, line=text.count("\n", 0, error.position) + 1, column=error.position - line_start)
        problems.append(place.problem(f"not valid YAML: {error.reason}, got the character {error.character:#04x}"))
    except YAMLError as error:
        problems.append(place.problem(f"not valid YAML: {error}"))
    except RecursionError:
        message = "not a spec: nested too deeply; does an alias stand in the value that it repeats?"
        problems.append(place.problem(message))
    return Written(None, place)


def _syntax_problem(error: MarkedYAMLError, reader: _Reader) -> Problem:
    message, context = f"not valid YAML: {error.problem}", error.context or ""
    if "'\\t'" in message:
        message += "; indent with spaces, not with tabs"
    if context.startswith("expected"):
        message = f"not valid YAML: {context} {error.problem}"
    elif error.context_mark and not reader.root.override:
        message += f" ({context} that starts in line {error.context_mark.line + 1})"
    place = reader.marked(error.problem_mark, reader.root.where) if error.problem_mark else reader.root
    return place.problem(message)


class _Reader:
    """Reads the nodes of one document; what cannot be read becomes a problem, and nothing in its place."""

    def __init__(self, yaml: YAML, root: Place, problems: list[Problem]) -> None:
        self.yaml, self.root, self.problems = yaml, root, problems

    def marked(self, mark: StringMark, where: str) -> Place:
        """Return the place of a mark; an override has no lines."""
        if self.root.override is not None:
            return replace(self.root, where=where)
        return replace(self.root, where=where, line=mark.line + 1, column=mark.column + 1)

    def place(self, node: Node, where: str) -> Place:
        return self.marked(node.start_mark, where)

    def value(self, node: Node, place: Place) -> Written:
        """Read a node, whose place is that of its key, or where it begins if it has none."""
        tag = str(node.tag).removeprefix(TAG)
        if tag not in KNOWN:
            return self.unreadable(place, f"tags such as {str(node.tag).replace(TAG, '!!')} are not allowed")
        if isinstance(node, ScalarNode):
            return self.scalar(node, tag, place)
        if isinstance(node, MappingNode):
            return self.mapping(node, place)
        items = enumerate(node.value)
        return Written([self.value(item, self.place(item, joined(place.where, index))) for index, item in items], place)

    def mapping(self, node: MappingNode, place: Place) -> Written:
        """Read a mapping; the first of duplicate keys stays, and the mapping's own keys win over those that are merged in."""
        where = place.where
        content: dict[str, Written] = {}
        merged = Written({}, place)
        for key_node, item in node.value:
            key = key_node.value
            if key_node.tag == f"{TAG}merge":
                for source in self.merged(item, where):
                    is_readable = merged.place.is_readable and source.place.is_readable
                    merged = Written(merged.laid_over(source).data, replace(place, is_readable=is_readable))
            elif key_node.tag != f"{TAG}str":
                got = (f"{key}; quote it" if key else "nothing") if isinstance(key, str) else "a list or a mapping"
                if isinstance(key, str) and key.isdigit() and item.value == "":
                    got = f"{key}; in {{...}}, a comma ends a value: write numbers without commas"
                self.report(key_node, where, f"a key is text, got {got}")
            elif key in content:
                line = content[key].place.line
                first = f" in line {line}" if line else ""
                self.report(key_node, joined(where, key), f"the key is given twice, first{first}")
            else:
                content[key] = self.keyed(key_node, item, joined(where, key))
        return merged.having(content)

    def keyed(self, key: Node, node: Node, where: str) -> Written:
        """Read the value of a key, whose place is that of the key; without a value, it has no other."""
        place, value = self.place(key, where), self.place(node, where)
        is_empty = node.tag == f"{TAG}null" and node.value == ""
        start = (value.line, value.column) if value.line and value.column and not is_empty else None
        return self.value(node, replace(place, start=start))

    def merged(self, node: Node, where: str) -> list[Written]:
        """Read what stands under a merge key: a mapping, or a list of mappings of which the first wins."""
        sources = [node] if isinstance(node, MappingNode) else node.value
        if all(isinstance(source, MappingNode) for source in sources):
            return [self.value(source, self.place(source, where)) for source in sources]
        self.report(node, where, "<< merges mappings, expected a mapping or a list of mappings")
        return []

    def report(self, node: Node, where: str, message: str) -> None:
        self.problems.append(self.place(node, where).problem(message))

    def unreadable(self, place: Place, message: str) -> Written:
        """Report a value that cannot be read, at its beginning."""
        line, column = place.start or (place.line, place.column)
        self.problems.append(replace(place, line=line, column=column).problem(message))
        return Written(None, replace(place, is_readable=False))

    def scalar(self, node: ScalarNode, tag: str, place: Place) -> Written:
        """Read a scalar; a whole number such as 1e3 is an integer."""
        text = str(node.value)
        if tag not in ("null", "bool", "int", "float"):
            return Written(text, place)
        try:
            value = self.yaml.constructor.construct_object(node)
        except (KeyError, ValueError):
            expected = {"bool": "true or false", "int": "an integer"}.get(tag, "a number")
            return self.unreadable(place, f"expected {expected}, got {given(text)}")
        is_whole = tag == "float" and WHOLE.fullmatch(text) and abs(value) < 2**53
        return Written(int(value) if is_whole else value, place)
