"""Validate plain data against a model, and put what is wrong into plain words."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, TypeVar

from pydantic import BaseModel, ValidationError

from photonpano.registry.schema_text import alternative, alternatives, config_schema, discriminator, expectation, subschema
from photonpano.specs.written import Written, given
from photonpano.text import listed

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from photonpano.registry.schema_text import Schema
    from photonpano.specs.spec import Spec

ModelT = TypeVar("ModelT", bound=BaseModel)

# Errors that a validator of the model raised itself: its sentence is the message.
RAISED = {"value_error", "assertion_error"}
# Errors, beside those of type, whose message is what the schema expects and what was given.
EXPECTED = {
    *("greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number", "multiple_of"),
    *("too_short", "too_long", "string_too_short", "string_too_long", "string_pattern_mismatch"),
    *("literal_error", "enum", "byte_size", "byte_size_unit", "missing"),
}
NUMBER = re.compile(r"\s*[-+]?[\d.]+([eE][-+]?\d+)?\s*")


def validate(model: type[ModelT], section: Written, spec: Spec) -> ModelT | None:
    """Validate a section; types are those of YAML, so text is no number and a number no switch.

    Args:
        model: the model of the section.
        section: a mapping; nothing counts as an empty one.
        spec: problems are added here.

    Returns:
        None if something is wrong.
    """
    content = spec.mapping(section)
    if content is None:
        return None
    try:
        return model.model_validate_json(json.dumps(content.plain()), strict=True, context={"directory": spec.directory})
    except ValidationError as error:
        schema, n_problems = config_schema(model), len(spec.problems)
        for each in error.errors(include_url=False):
            _report(each, content, schema, spec)
        # The alternatives of a union fail one by one, with one sentence.
        spec.problems[n_problems:] = dict.fromkeys(spec.problems[n_problems:])
    return None


def _report(error: ErrorDetails, value: Written, root: Schema, spec: Spec) -> None:
    kind, steps, schema = error["type"], list(error["loc"]), root
    # The last step is a key that is missing or unknown, or an item that is missing.
    last = steps.pop() if kind in ("missing", "extra_forbidden") else ""
    for step in steps:
        if value.at(step).place.is_written:
            schema, value = subschema(schema, step, root), value.at(step)
        else:  # the step names an alternative of a union
            schema = alternative(schema, step, root)
    tag_key, tags = discriminator(schema, root)
    if kind == "missing" and isinstance(last, str):
        spec.wrong_key(value.at(last), f"required: {expectation(subschema(schema, last, root), root)}")
    elif kind == "extra_forbidden":
        known = [key for option in alternatives(schema, root) for key in option.get("properties", ())]
        spec.wrong_key(value.at(last), spec.unknown_key(str(last), value, known))
    elif kind == "union_tag_not_found" and tag_key:
        spec.wrong_key(value.at(tag_key), f"required: {listed(tags, 'or')}")
    elif kind == "union_tag_invalid" and tag_key:
        spec.wrong(value.at(tag_key), f"expected {listed(tags, 'or')}, got {given(value.at(tag_key).data)}")
    elif kind in RAISED:
        spec.wrong(value, str(error["ctx"]["error"]))
    elif schema and (kind in EXPECTED or kind.endswith("_type")):
        number = kind in ("int_type", "float_type") and isinstance(value.data, str) and NUMBER.fullmatch(value.data)
        got = f"the text {given(value.data)}; leave the quotes out" if number else given(value.data)
        spec.wrong(value, f"expected {expectation(schema, root)}, got {got}")
    else:
        spec.wrong(value, f"{error['msg'][:1].lower()}{error['msg'][1:]}, got {given(value.data)}")
