"""Read YAML into plain data with a table of places. Nothing is constructed from tags, so nothing in a file is executed."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode
from ruamel.yaml.reader import ReaderError

from photonpano.specs.written import Place, WrittenSpec, given, joined

if TYPE_CHECKING:
    from ruamel.yaml.error import StringMark
    from ruamel.yaml.nodes import Node

    from photonpano.errors import Problem

TAG = "tag:yaml.org,2002:"
WHOLE = re.compile(r"[-+]?\d+[eE]\+?\d{1,2}")
MAX_LENGTH = 2**18
"""The largest number of characters of a spec, or bytes of its file: a text of a megabyte takes 4 s to read."""
MAX_VALUES = 5000
"""The largest number of values in a spec; aliases of aliases multiply."""
MAX_DEPTH = 100
"""How deeply values may be nested in a spec."""


class _TooLongError(Exception):
    """More than `MAX_VALUES` values."""


class _Composer(Composer):
    """Stops at files that are no specs, which take a minute otherwise: a megabyte holds 500,000 values."""

    n_values = 0
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.n_values += 1
        self.depth += 1
        if self.n_values > 2 * MAX_VALUES:  # keys count here
            raise _TooLongError
        if self.depth > MAX_DEPTH:
            raise RecursionError
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def read_yaml(text: str, place: Place) -> WrittenSpec:
    """Read one YAML 1.2 document; aliases and merge keys are followed.

    Args:
        text: the document.
        place: where the document stands; lines and columns are filled in unless it is an override.

    Returns:
        The document, with problems if something cannot be read; its data is None if the text is not YAML or holds no document.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = _Composer
    yaml.composer.warn_double_anchors = False
    reader = _Reader(place)
    problems = reader.spec.problems
    if len(text) > MAX_LENGTH:
        problems.append(place.problem(f"not a spec: longer than {MAX_LENGTH} characters"))
        return reader.spec
    try:
        node = yaml.compose(text)
        if node is not None:
            reader.spec.data = reader.value(node, place.where)
    except MarkedYAMLError as error:
        problems.append(_syntax_problem(error, reader))
    except ReaderError as error:
        if not place.override:
            line_start = text.rfind("\n", 0, error.position)
            place = replace(place, line=text.count("\n", 0, error.position) + 1, column=error.position - line_start)
        problems.append(place.problem(f"not valid YAML: {error.reason}, got the character {error.character:#04x}"))
    except YAMLError as error:
        problems.append(place.problem(f"not valid YAML: {error}"))
    except _TooLongError:
        problems.append(place.problem(f"not a spec: with its aliases expanded it has more than {MAX_VALUES} values"))
    except RecursionError:
        problems.append(place.problem("not a spec: nested too deeply"))
    return reader.spec


def _syntax_problem(error: MarkedYAMLError, reader: _Reader) -> Problem:
    message, context = f"not valid YAML: {error.problem}", error.context or ""
    if "'\\t'" in message:
        message += "; indent with spaces, not with tabs"
    if context.startswith("expected"):
        message = f"not valid YAML: {context} {error.problem}"
    elif error.context_mark and not reader.root.override:
        message += f" ({context} that starts in line {error.context_mark.line + 1})"
    return (reader.place(error.problem_mark, reader.root.where) if error.problem_mark else reader.root).problem(message)


class _Reader:
    """Reads the nodes of one document."""

    def __init__(self, root: Place) -> None:
        self.root = root
        self.spec = WrittenSpec(None, {root.where: root})
        self.count = 0
        self.open: set[int] = set()

    def place(self, mark: StringMark, where: str) -> Place:
        """Return the place of a mark; an override has no lines."""
        if self.root.override is not None:
            return replace(self.root, where=where)
        return replace(self.root, where=where, line=mark.line + 1, column=mark.column + 1)

    def value(self, node: Node, where: str, key: Place | None = None) -> Any:
        """Read a node; what cannot be read becomes a problem and None."""
        self.count += 1
        if self.count > MAX_VALUES:
            raise _TooLongError
        place = self.place(node.start_mark, where)
        if key is not None and node.tag == f"{TAG}null" and node.value == "":
            self.spec.places[where] = key  # nothing was written, so there is no place but the key's
            return None
        start = (place.line, place.column) if place.line and place.column else None
        self.spec.places[where] = place if key is None else replace(key, start=start)
        if isinstance(node, ScalarNode):
            return self.scalar(node, where)
        if not self.is_known(node, where, "map", "seq"):
            return None
        if id(node) in self.open:
            self.unreadable(where, "an alias inside the value that it repeats")
            return None
        self.open.add(id(node))
        try:
            if isinstance(node, MappingNode):
                return self.mapping(node, where)
            return [self.value(item, joined(where, index)) for index, item in enumerate(node.value)]
        finally:
            self.open.discard(id(node))

    def mapping(self, node: MappingNode, where: str) -> dict[str, Any]:
        """Read a mapping; the first of duplicate keys stays, and the mapping's own keys win over those that are merged in."""
        merged: dict[str, Any] = {}
        for key_node, item in node.value:
            if key_node.tag == f"{TAG}merge":
                merged = self.merged(item, where) | merged
        content: dict[str, Any] = {}
        for key_node, item in node.value:
            key = key_node.value
            if key_node.tag == f"{TAG}merge":
                continue
            if key_node.tag != f"{TAG}str":
                got = (f"{key}; quote it" if key else "nothing") if isinstance(key, str) else "a list or a mapping"
                self.report(key_node, where, f"a key is text, got {got}")
            elif key in content:
                first = self.spec.places[joined(where, key)].line
                self.report(
                    key_node, joined(where, key), f"the key is given twice, first{f' in line {first}' if first else ''}"
                )
            else:
                path = joined(where, key)
                if path in self.spec.places:  # that of a value which was merged in
                    self.spec.replace_places(path, {})
                content[key] = self.value(item, path, self.place(key_node.start_mark, path))
        return merged | content

    def merged(self, node: Node, where: str) -> dict[str, Any]:
        """Read what stands under a merge key: a mapping, or a list of mappings of which the first wins."""
        content: dict[str, Any] = {}
        place = self.spec.places[where]
        for source in reversed([node] if isinstance(node, MappingNode) else node.value):
            if not isinstance(source, MappingNode):
                self.report(node, where, "<< merges mappings, expected a mapping or a list of mappings")
                return {}
            content |= self.value(source, where) or {}
        self.spec.places[where] = place
        return content

    def report(self, node: Node, where: str, message: str) -> None:
        """Report a problem at a node."""
        self.spec.problems.append(self.place(node.start_mark, where).problem(message))

    def unreadable(self, where: str, message: str) -> None:
        """Report a value that cannot be read, and return None in its place."""
        self.spec.wrong(where, message)
        self.spec.unreadable.add(where)

    def is_known(self, node: Node, where: str, *names: str) -> bool:
        """Return whether the tag of a node is one of these; any other is a problem."""
        if node.tag in {f"{TAG}{name}" for name in names}:
            return True
        self.unreadable(where, f"tags such as {str(node.tag).replace(TAG, '!!')} are not allowed")
        return False

    def scalar(self, node: ScalarNode, where: str) -> str | int | float | bool | None:
        """Read a scalar; dates are text."""
        if not self.is_known(node, where, "null", "bool", "int", "float", "str", "timestamp", "value"):
            return None
        text = str(node.value)
        tag = str(node.tag).removeprefix(TAG)
        try:
            match tag:
                case "null":
                    return None
                case "bool":
                    return text.lower() in ("true", "yes", "on")
                case "int":
                    digits = text.replace("_", "")
                    return int(digits, 0 if digits.lstrip("+-")[:2] in ("0x", "0o", "0b") else 10)
                case "float" if WHOLE.fullmatch(text) and abs(float(text)) < 2**53:
                    return int(float(text))  # 1e3 frames are as good as 1000
                case "float":
                    return float(text.replace("_", "").lower().replace(".inf", "inf").replace(".nan", "nan"))
            text.encode()  # refuses half of a surrogate pair, which JSON and file systems cannot hold
        except ValueError:
            expected = {"int": "an integer", "float": "a number"}.get(tag, "text")
            self.unreadable(where, f"expected {expected}, got {given(text)}")
            return None
        return text
