"""Read YAML into values with their places. Nothing is constructed from tags, so nothing in a file is executed."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode
from ruamel.yaml.reader import ReaderError

from photonpano.specs.tree import Place, Value, joined

if TYPE_CHECKING:
    from ruamel.yaml.error import StringMark
    from ruamel.yaml.nodes import Node

    from photonpano.errors import Problem
    from photonpano.specs.tree import Scalar

TAG = "tag:yaml.org,2002:"
WHOLE = re.compile(r"[-+]?\d+[eE]\+?\d{1,2}")
MAX_VALUES = 20_000
"""Aliases of aliases multiply; no spec is as long as this."""


class _TooLongError(Exception):
    """More than `MAX_VALUES` values."""


def read_yaml(text: str, problems: list[Problem], place: Place) -> Value | None:
    """Read one YAML 1.2 document; aliases and merge keys are followed.

    Args:
        text: the document.
        problems: what is wrong with it is added here.
        place: where the document stands; lines and columns are filled in unless it is an override.

    Returns:
        None if the text is not YAML, or holds no document.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.composer.warn_double_anchors = False
    reader = _Reader(problems, place)
    try:
        node = yaml.compose(text)
        return None if node is None else reader.value(node, place.where)
    except MarkedYAMLError as error:
        problems.append(_syntax_problem(error, reader))
    except ReaderError as error:
        at = place if place.override else _at(text, error.position, place)
        problems.append(at.problem(f"not valid YAML: {error.reason}, got the character {error.character:#04x}"))
    except YAMLError as error:
        problems.append(place.problem(f"not valid YAML: {error}"))
    except _TooLongError:
        problems.append(place.problem(f"no spec: with its aliases repeated it has more than {MAX_VALUES} values"))
    except RecursionError:
        problems.append(place.problem("no spec: nested too deeply"))
    return None


def _syntax_problem(error: MarkedYAMLError, reader: _Reader) -> Problem:
    message, context = f"not valid YAML: {error.problem}", error.context or ""
    if "'\\t'" in message:
        message += "; indent with spaces, not with tabs"
    if context.startswith("expected"):
        message = f"not valid YAML: {context} {error.problem}"
    elif error.context_mark and not reader.root.override:
        message += f" ({context} that starts in line {error.context_mark.line + 1})"
    at = reader.place(error.problem_mark, reader.root.where) if error.problem_mark else reader.root
    return at.problem(message)


def _at(text: str, position: int, place: Place) -> Place:
    line, column = text.count("\n", 0, position) + 1, position - text.rfind("\n", 0, position)
    return replace(place, line=line, column=column)


class _Reader:
    """Turns the nodes of one document into values."""

    def __init__(self, problems: list[Problem], root: Place) -> None:
        self.problems = problems
        self.root = root
        self.count = 0
        self.open: set[int] = set()

    def place(self, mark: StringMark, where: str) -> Place:
        """Return the place of a mark; an override has no lines."""
        if self.root.override is not None:
            return replace(self.root, where=where)
        return replace(self.root, where=where, line=mark.line + 1, column=mark.column + 1)

    def value(self, node: Node, where: str, key: Place | None = None) -> Value:
        """Read a node; what cannot be read becomes a problem and null."""
        self.count += 1
        if self.count > MAX_VALUES:
            raise _TooLongError
        place = self.place(node.start_mark, where)
        if node.tag == f"{TAG}null" and node.value == "" and key is not None:
            return Value(None, key, key)  # nothing was written, so there is no place but the key's
        if isinstance(node, ScalarNode):
            before = len(self.problems)
            return Value(self.scalar(node, place), place, key, readable=len(self.problems) == before)
        if not self.is_known(node, place, "map", "seq"):
            return Value(None, place, key, readable=False)
        if id(node) in self.open:
            self.problems.append(place.problem("an alias stands inside what it repeats"))
            return Value(None, place, key, readable=False)
        self.open.add(id(node))
        content = self.mapping(node, where) if isinstance(node, MappingNode) else self.items(node.value, where)
        self.open.discard(id(node))
        return Value(content, place, key)

    def items(self, nodes: list[Node], where: str) -> list[Value]:
        """Read a list."""
        return [self.value(item, joined(where, index)) for index, item in enumerate(nodes)]

    def mapping(self, node: MappingNode, where: str) -> dict[str, Value]:
        """Read a mapping; of duplicate keys the first stays, and what is merged in stands behind its own keys."""
        content: dict[str, Value] = {}
        merged: dict[str, Value] = {}
        for key_node, item in node.value:
            if key_node.tag == f"{TAG}merge":
                merged = self.merged(item, where) | merged
                continue
            key = key_node.value
            if key_node.tag != f"{TAG}str":
                got = (f"{key}; quote it" if key else "nothing") if isinstance(key, str) else "a list or a mapping"
                self.problems.append(self.place(key_node.start_mark, where).problem(f"a key is text, got {got}"))
                continue
            place = self.place(key_node.start_mark, joined(where, key))
            if key in content:
                first = content[key].head
                line = f" in line {first.line}" if first.line else ""
                self.problems.append(place.problem(f"the key is given twice, first{line}"))
                continue
            content[key] = self.value(item, place.where, place)
        return merged | content

    def merged(self, node: Node, where: str) -> dict[str, Value]:
        """Read what stands under a merge key: a mapping, or a list of mappings of which the first wins."""
        content: dict[str, Value] = {}
        for source in reversed([node] if isinstance(node, MappingNode) else node.value):
            if not isinstance(source, MappingNode):
                self.problems.append(self.place(node.start_mark, where).problem("<< merges mappings, got something else"))
                return {}
            value = self.value(source, where)
            content |= value.content if isinstance(value.content, dict) else {}
        return content

    def is_known(self, node: Node, place: Place, *names: str) -> bool:
        """Tell whether a tag is one of these; any other is a problem."""
        if node.tag in {f"{TAG}{name}" for name in names}:
            return True
        self.problems.append(place.problem(f"tags such as {str(node.tag).replace(TAG, '!!')} are not allowed"))
        return False

    def scalar(self, node: ScalarNode, place: Place) -> Scalar:
        """Read a scalar; dates are text."""
        if not self.is_known(node, place, "null", "bool", "int", "float", "str", "timestamp", "value"):
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
            self.problems.append(place.problem(f"expected {expected}, got {text!a}"))
            return None
        return text
