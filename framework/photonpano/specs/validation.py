"""Validate a section against its model, and say in plain words what is wrong."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, TypeVar

from pydantic import BaseModel, ValidationError

from photonpano.registry.schema_text import alternative, config_schema, discriminator, expectation, keys_of, subschema
from photonpano.specs.tree import Value, given
from photonpano.text import listed, suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from pydantic_core import ErrorDetails

    from photonpano.errors import Problem
    from photonpano.registry.schema_text import Schema

ModelT = TypeVar("ModelT", bound=BaseModel)

OWN_WORDS = {"value_error", "assertion_error"}
"""Errors that a validator of the model raised itself: its sentence is the message."""
SAID_BY_SCHEMA = {
    *("greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number", "multiple_of"),
    *("too_short", "too_long", "string_too_short", "string_too_long", "string_pattern_mismatch"),
    *("literal_error", "enum", "byte_size", "byte_size_unit", "missing"),
}
"""Errors, beside those of type, that the words of the schema explain better than pydantic does."""
NUMBER = re.compile(r"\s*[-+]?[\d.]+([eE][-+]?\d+)?\s*")


def validate(model: type[ModelT], section: Value, directory: Path, problems: list[Problem]) -> ModelT | None:
    """Validate a section; values are taken as YAML gives them, so text is no number and a number no switch.

    Args:
        model: what the section is to become.
        section: a mapping; null counts as an empty one.
        directory: what relative paths count from.
        problems: what is wrong is added here, each at its place.

    Returns:
        None if something is wrong.
    """
    content = {} if section.content is None else section.content
    if not isinstance(content, dict):
        problems.append(section.place.problem(f"expected a mapping, got {given(content)}"))
        return None
    section = Value(content, section.place, section.key)
    try:
        return model.model_validate_json(json.dumps(section.plain()), strict=True, context={"directory": directory})
    except ValidationError as error:
        root = config_schema(model)
        found = [_problem(each, section, root) for each in error.errors(include_url=False)]
        problems += dict.fromkeys(found)  # the alternatives of a union fail one by one, with one sentence
    return None


def unknown_key(key: str, known: Iterable[str]) -> str:
    """Say that a mapping has no such key, and which it has."""
    return f"unknown key; {suggestion(key, known) or 'no keys are allowed here'}"


def _problem(error: ErrorDetails, section: Value, root: Schema) -> Problem:
    value, schema, parent = section, root, root
    for step in error["loc"]:  # steps that lead nowhere name an alternative of a union, or a key that is missing
        child = _child(value, step)
        if child is None:
            schema = alternative(schema, step, root)
        else:
            parent, value, schema = schema, child, subschema(schema, step, root)
    kind = error["type"]
    tag_key, tags = discriminator(schema, root)
    if kind == "union_tag_not_found" and tag_key:
        return value.head.problem(f"required: {listed(tags, 'or')}", tag_key)
    if kind == "union_tag_invalid" and tag_key and (tag := _child(value, tag_key)):
        return tag.place.problem(f"expected {listed(tags, 'or')}, got {given(tag.content)}")
    if kind == "missing" and isinstance(key := error["loc"][-1], str):
        return value.head.problem(f"required: {expectation(subschema(schema, key, root), root)}", key)
    if kind == "extra_forbidden":
        return value.head.problem(unknown_key(str(error["loc"][-1]), keys_of(parent, root)))
    if kind in OWN_WORDS:
        return value.place.problem(str(error["ctx"]["error"]))
    if schema and (kind in SAID_BY_SCHEMA or kind.endswith("_type")):
        return value.place.problem(f"expected {expectation(schema, root)}, got {_given(value, kind)}")
    return value.place.problem(f"{error['msg'][:1].lower()}{error['msg'][1:]}, got {given(value.content)}")


def _child(value: Value, step: str | int) -> Value | None:
    if isinstance(value.content, dict):
        return value.content.get(str(step))
    if isinstance(value.content, list) and isinstance(step, int) and step < len(value.content):
        return value.content[step]
    return None


def _given(value: Value, kind: str) -> str:
    quoted = kind in ("int_type", "float_type") and isinstance(value.content, str) and NUMBER.fullmatch(value.content)
    return f"the text {value.content!r}; leave the quotes out" if quoted else given(value.content)
