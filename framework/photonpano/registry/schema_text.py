"""Say in words what a config expects, from its JSON Schema."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

from pydantic import BaseModel, ByteSize, TypeAdapter
from pydantic.json_schema import GenerateJsonSchema

from photonpano.text import listed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic_core import core_schema

Schema: TypeAlias = "Mapping[str, Any]"
"""A JSON Schema, or a part of one."""

DEPTH = 4
"""A schema may contain itself; below this depth it is not put into words."""


class TolerantJsonSchema(GenerateJsonSchema):
    """Describes what JSON Schema can express, and leaves the rest open, so that one odd field spoils nothing else."""

    def tagged_union_schema(self, schema: core_schema.TaggedUnionSchema) -> dict[str, Any]:
        """Require the key that tells the alternatives apart, as validation does whatever its default."""
        described = super().tagged_union_schema(schema)
        if "discriminator" in described:
            described["required"] = [described["discriminator"]["propertyName"]]
        return described

    def handle_invalid_for_json_schema(self, schema: core_schema.CoreSchema, error_info: str) -> dict[str, Any]:
        """Accept anything."""
        del schema, error_info
        return {}


def config_schema(config: type[BaseModel]) -> Schema:
    """Return the JSON Schema of a config; what it refers to stands in its `$defs`."""
    schema = config.model_json_schema(schema_generator=TolerantJsonSchema)
    return resolved(schema, schema)


def resolved(schema: Schema, root: Schema) -> Schema:
    """Follow a `$ref` into the definitions of the root."""
    if "$ref" not in schema:
        return schema
    target = root["$defs"][schema["$ref"].rpartition("/")[2]]
    return {**target, **{key: value for key, value in schema.items() if key != "$ref"}}


def alternatives(schema: Schema, root: Schema) -> list[Schema]:
    """Return what a union consists of; anything else consists of itself."""
    schema = resolved(schema, root)
    options = schema.get("anyOf") or schema.get("oneOf")
    return [each for option in options for each in alternatives(option, root)] if options else [schema]


def discriminator(schema: Schema, root: Schema) -> tuple[str | None, list[str]]:
    """Return the key that tells the alternatives of a union of mappings apart, and its values; None if there is none."""
    found = resolved(schema, root).get("discriminator", {})
    return found.get("propertyName"), list(found.get("mapping", ()))


def alternative(schema: Schema, tag: object, root: Schema) -> Schema:
    """Return the alternative of a union that has this tag, or is the only mapping; else the schema itself."""
    schema = resolved(schema, root)
    reference = schema.get("discriminator", {}).get("mapping", {}).get(tag)
    if reference is not None:
        return resolved({"$ref": reference}, root)
    mappings = [option for option in alternatives(schema, root) if "properties" in option]
    return mappings[0] if len(mappings) == 1 else schema


def subschema(schema: Schema, key: str | int, root: Schema) -> Schema:
    """Return the schema of one key or item; empty, which allows anything, if there is none."""
    for option in alternatives(schema, root):
        if isinstance(key, int):
            first = option.get("prefixItems", ())
            found = first[key] if key < len(first) else option.get("items")
        else:
            found = option.get("properties", {}).get(key) or option.get("additionalProperties")
        if isinstance(found, dict):
            return found
    return {}


def keys_of(schema: Schema, root: Schema) -> list[str]:
    """Return the keys that a mapping may have."""
    return [key for option in alternatives(schema, root) for key in option.get("properties", ())]


def expectation(schema: Schema, root: Schema) -> str:
    """Say what is expected, as in "an integer of at least 1" or "first, last or a number from 0 to 1"."""
    return listed((str(option) for option in _options(schema, root)), "or")


def type_words(schema: Schema, root: Schema) -> str:
    """Say the type alone, as in "integer" or "first, last or number"."""
    return listed((option.noun for option in _options(schema, root)), "or")


def bounds_words(schema: Schema, root: Schema) -> str:
    """Say the bounds alone, as in "at least 1"; empty if there are none."""
    bounds = [option.bounds for option in _options(schema, root) if option.bounds]
    return listed(bounds, "or") if bounds else ""


@dataclass(frozen=True, slots=True)
class _Option:
    """One of the things that a value may be."""

    noun: str
    bounds: str = ""
    article: str = ""
    plural: str = ""

    def __str__(self) -> str:
        bounds = f"of {self.bounds}" if self.bounds.startswith("at ") else self.bounds
        return " ".join(part for part in (self.article, self.noun, bounds) if part)


def _options(schema: Schema, root: Schema, depth: int = 0) -> list[_Option]:
    schema = resolved(schema, root)
    union = schema.get("anyOf") or schema.get("oneOf")
    if depth == DEPTH:
        return [_Option("value", article="a", plural="values")]
    if union and union == _byte_size():
        return [_Option("size", _byte_bounds(schema), "a", "sizes")]
    if union:
        return list(dict.fromkeys(option for each in union for option in _options(each, root, depth + 1)))
    if "enum" in schema or "const" in schema:
        return [_Option(word(value)) for value in schema.get("enum", [schema.get("const")])]
    match schema.get("type"):
        case "integer":
            return [_Option("integer", _range(schema), "an", "integers")]
        case "number":
            return [_Option("number", _range(schema), "a", "numbers")]
        case "boolean":
            return [_Option("true or false")]
        case "null":
            return [_Option("null")]
        case "object":
            return [_Option("mapping", article="a", plural="mappings")]
        case "string" if str(schema.get("format", "")).endswith("path"):
            return [_Option("path", article="a", plural="paths")]
        case "string":
            return [_Option("text", _text_bounds(schema), plural="texts")]
        case "array":
            return [_list(schema, root, depth)]
    return [_Option("value", article="a", plural="values")]


def _list(schema: Schema, root: Schema, depth: int) -> _Option:
    kinds = [schema["items"]] if "items" in schema else schema.get("prefixItems", [])
    inner = {option for kind in kinds for option in _options(kind, root, depth + 1)}
    only = inner.pop() if len(inner) == 1 else _Option("")
    least, most = schema.get("minItems"), schema.get("maxItems")
    each = f"each {only.bounds}" if only.bounds else ""
    if least is not None and least == most:
        return _Option(f"list of {least} {only.plural or 'items'}", each, "a", "lists")
    bounds = ", ".join(filter(None, (_count(least, most, "item"), each)))
    return _Option(f"list of {only.plural}" if only.plural else "list", bounds, "a", "lists")


def _range(schema: Schema) -> str:
    low, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    high, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    if low is not None and high is not None:
        words = [f"from {word(low)} to {word(high)}"]
    else:
        ends = (("at least", low), ("above", above), ("at most", high), ("below", below))
        words = [" and ".join(f"{name} {word(value)}" for name, value in ends if value is not None)]
    if "multipleOf" in schema:
        words.append(f"a multiple of {word(schema['multipleOf'])}")
    return ", ".join(filter(None, words))


def _text_bounds(schema: Schema) -> str:
    count = _count(schema.get("minLength"), schema.get("maxLength"), "character")
    pattern = f"that matches {schema['pattern']}" if "pattern" in schema else ""
    return ", ".join(filter(None, (count, pattern)))


def _count(least: int | None, most: int | None, noun: str) -> str:
    if least and most is not None:
        return f"with {least} to {most} {noun}s"
    if least:
        return f"with at least {least} {noun}{'' if least == 1 else 's'}"
    return "" if most is None else f"with at most {most} {noun}{'' if most == 1 else 's'}"


@cache
def _byte_size() -> list[Any]:
    alternatives: list[Any] = TypeAdapter(ByteSize).json_schema()["anyOf"]
    return alternatives


def _byte_bounds(schema: Schema) -> str:
    example = "such as 2 GiB"
    if "ge" not in schema:
        return example
    return f"at least {ByteSize(schema['ge']).human_readable(separator=' ').replace('.0 ', ' ')}, {example}"


def word(value: object) -> str:
    """Write a value as YAML would, whole numbers without a point."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float):
        return f"{value:.15g}".replace("inf", ".inf").replace("nan", ".nan")
    return str(value)
