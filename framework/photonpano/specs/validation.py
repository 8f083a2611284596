"""Validate plain data against a model, and put what is wrong into plain words."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ValidationError

from photonpano.registry.schema_text import alternative, alternatives, config_schema, discriminator, expectation, subschema
from photonpano.specs.written import WrittenSpec, given, joined
from photonpano.text import listed

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from photonpano.registry.schema_text import Schema

ModelT = TypeVar("ModelT", bound=BaseModel)

RAISED = {"value_error", "assertion_error"}
"""Errors that a validator of the model raised itself: its sentence is the message."""
EXPECTED = {
    *("greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number", "multiple_of"),
    *("too_short", "too_long", "string_too_short", "string_too_long", "string_pattern_mismatch"),
    *("literal_error", "enum", "byte_size", "byte_size_unit", "missing"),
}
"""Errors, beside those of type, whose message is what the schema expects and what was given."""
NUMBER = re.compile(r"\s*[-+]?[\d.]+([eE][-+]?\d+)?\s*")


def validate(model: type[ModelT], data: Any, where: str, spec: WrittenSpec) -> ModelT | None:
    """Validate a section; types are those of YAML, so text is no number and a number no switch.

    Args:
        model: the model of the section.
        data: a mapping; None counts as an empty one.
        where: the path of the section.
        spec: problems are added here.

    Returns:
        None if something is wrong.
    """
    section = spec.mapping(data, where)
    if section is None:
        return None
    try:
        return model.model_validate_json(json.dumps(section), strict=True, context={"directory": spec.directory})
    except ValidationError as error:
        schema, n_problems = config_schema(model), len(spec.problems)
        for each in error.errors(include_url=False):
            _report(each, section, where, schema, spec)
        # The alternatives of a union fail one by one, with one sentence.
        spec.problems[n_problems:] = dict.fromkeys(spec.problems[n_problems:])
    return None


def _report(error: ErrorDetails, value: Any, where: str, root: Schema, spec: WrittenSpec) -> None:
    kind, steps, schema = error["type"], list(error["loc"]), root
    # The last step is a key that is missing or unknown, or an item that is missing.
    last = steps.pop() if kind in ("missing", "extra_forbidden") else ""
    for step in steps:
        child = _child(value, step)
        if child is None:  # the step names an alternative of a union
            schema = alternative(schema, step, root)
        else:
            schema, (value,), where = subschema(schema, step, root), child, joined(where, step)
    tag_key, tags = discriminator(schema, root)
    if kind == "missing" and isinstance(last, str):
        spec.wrong_key(joined(where, last), f"required: {expectation(subschema(schema, last, root), root)}")
    elif kind == "extra_forbidden":
        known = [key for option in alternatives(schema, root) for key in option.get("properties", ())]
        spec.wrong_key(joined(where, last), spec.unknown_key(str(last), where, known))
    elif kind == "union_tag_not_found" and tag_key:
        spec.wrong_key(joined(where, tag_key), f"required: {listed(tags, 'or')}")
    elif kind == "union_tag_invalid" and tag_key:
        spec.wrong(joined(where, tag_key), f"expected {listed(tags, 'or')}, got {given(value[tag_key])}")
    elif kind in RAISED:
        spec.wrong(where, str(error["ctx"]["error"]))
    elif schema and (kind in EXPECTED or kind.endswith("_type")):
        number = kind in ("int_type", "float_type") and isinstance(value, str) and NUMBER.fullmatch(value)
        got = f"the text {given(value)}; leave the quotes out" if number else given(value)
        spec.wrong(where, f"expected {expectation(schema, root)}, got {got}")
    else:
        spec.wrong(where, f"{error['msg'][:1].lower()}{error['msg'][1:]}, got {given(value)}")


def _child(value: Any, step: str | int) -> tuple[Any] | None:
    """Return the value of a key or an item, in a tuple of one; None if there is none."""
    if isinstance(value, dict) and str(step) in value:
        return (value[str(step)],)
    if isinstance(value, list) and isinstance(step, int) and step < len(value):
        return (value[step],)
    return None
