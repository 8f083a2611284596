"""Describe a component, and the JSON Schema of its config, in words."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TypeAlias

from pydantic import BaseModel, ByteSize, TypeAdapter
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from photonpano.plugins.contributions import KINDS, Contribution, RunKindContribution
from photonpano.text import byte_size, listed

Schema: TypeAlias = "Mapping[str, Any]"  # A JSON Schema, or a part of one

_MAX_DEPTH = 4  # the depth down to which a schema, which may contain itself, is put into words
# What a value may be, apart from one of several words.
_NOUNS = ("integer", "number", "mapping", "path", "size", "list", "value", "text")


class TolerantJsonSchema(GenerateJsonSchema):
    """Describes what JSON Schema can express, and leaves the rest open, so that one odd field spoils nothing else."""

    def tagged_union_schema(self, schema: core_schema.TaggedUnionSchema) -> dict[str, Any]:
        """Require the key that distinguishes the alternatives, as validation does whatever its default."""
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
    """Return the members of a union; anything else is its only member."""
    schema = resolved(schema, root)
    options = schema.get("anyOf") or schema.get("oneOf")
    return [each for option in options for each in alternatives(option, root)] if options else [schema]


def discriminator(schema: Schema, root: Schema) -> tuple[str | None, list[str]]:
    """Return the key that distinguishes the alternatives of a union of mappings, and its values; None if there is none."""
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


def expectation(schema: Schema, root: Schema) -> str:
    """Return what is expected, as in "an integer of at least 1" or "first, last or a number from 0 to 1"."""
    return listed((_with_bounds(noun, bounds) for noun, bounds in _options(schema, root)), "or")


def _with_bounds(noun: str, bounds: str) -> str:
    kind = noun.partition(" ")[0]
    article = "an " if kind == "integer" else "a " if kind in _NOUNS and kind != "text" else ""
    return f"{article}{noun}{' of' if bounds.startswith('at ') else ''}{' ' if bounds else ''}{bounds}"


def _options(schema: Schema, root: Schema, depth: int = 0) -> list[tuple[str, str]]:
    """Return noun and bounds of each of the things that a value may be."""
    schema = resolved(schema, root)
    union = schema.get("anyOf") or schema.get("oneOf")
    kind = schema.get("type")
    if depth == _MAX_DEPTH:
        return [("value", "")]
    if union and union == _byte_size():
        least = f"at least {byte_size(schema['ge'])}, " if "ge" in schema else ""
        return [("size", f"{least}such as 2 GiB")]
    if union:
        return list(dict.fromkeys(option for each in union for option in _options(each, root, depth + 1)))
    if "enum" in schema or "const" in schema:
        return [(word(value), "") for value in schema.get("enum", [schema.get("const")])]
    if kind in ("integer", "number"):
        return [(kind, _range(schema))]
    if kind == "string":
        is_path = str(schema.get("format", "")).endswith("path")
        return [("path", "") if is_path else ("text", _text_bounds(schema))]
    if kind == "array":
        return [_list(schema, root, depth)]
    return [({"boolean": "true or false", "null": "null", "object": "mapping"}.get(str(kind), "value"), "")]


def _list(schema: Schema, root: Schema, depth: int) -> tuple[str, str]:
    kinds = [schema["items"]] if "items" in schema else schema.get("prefixItems", [])
    inner = {option for kind in kinds for option in _options(kind, root, depth + 1)}
    noun, bounds = inner.pop() if len(inner) == 1 else ("", "")
    kind, each = noun.partition(" ")[0], f"each {bounds.removeprefix('each ')}" if bounds else ""
    plural = f"{kind}s" if kind in _NOUNS else ""
    least, most = schema.get("minItems"), schema.get("maxItems")
    if least is not None and least == most:
        return f"list of {least} {plural or 'items'}", each
    return f"list of {plural}" if plural else "list", ", ".join(filter(None, (_count(least, most, "item"), each)))


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
    bound, limit = ("at least", least) if least else ("at most", most)
    return "" if limit is None else f"with {bound} {limit} {noun}{'' if limit == 1 else 's'}"


@cache
def _byte_size() -> list[Any]:
    alternatives: list[Any] = TypeAdapter(ByteSize).json_schema()["anyOf"]
    return alternatives


def word(value: object) -> str:
    """Write a value as YAML would, whole numbers without a point."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, float):
        return f"{value:.15g}".replace("inf", ".inf").replace("nan", ".nan")
    return str(value)


_PLAIN_TEXT = re.compile(r"[A-Za-z/][\w./-]*")
_NOT_PLAIN = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}
_COMPUTED = "computed"  # stands for a default that only the config itself can compute


@dataclass(frozen=True, slots=True)
class ConfigRow:
    """One key of a config, in words."""

    # the key under `with`; that of a mapping in a mapping with dots, such as `filter.size`, and that of a mapping in a list
    # with brackets, such as `filters[].size`
    key: str
    type: str  # such as "integer" or "first, last or number"
    default: str | None  # as it is written in YAML, or "computed"; None if the key is required
    bounds: str  # such as "at least 1"; empty if there are none
    description: str


def snippet(contribution: Contribution) -> str:
    """Return the section of a spec that uses a component, with all defaults; a key that is required has a value `<...>`."""
    if isinstance(contribution, RunKindContribution):
        return f"{contribution.section}:\n  use: <{contribution.component.kind}>\n"
    outer, _, inner = KINDS[contribution.kind].section.partition(".")
    if inner:
        keys = {row.key: row for row in config_rows(contribution.config) if "." not in row.key and row.default != _COMPUTED}
        written = ", ".join(
            f"{key}: {flow(f'<{row.type}>') if row.default is None else row.default}" for key, row in keys.items()
        )
        chosen = f"{{use: {contribution.name}, with: {{{written}}}}}" if written else contribution.name
        return f"{outer}:\n  {inner}: [{chosen}]\n"
    lines = [f"{outer}:", f"  use: {contribution.name}"]
    for row in config_rows(contribution.config):
        if "." in row.key or row.default == _COMPUTED:
            continue
        if len(lines) == 2:
            lines.append("  with:")
        comment = f"  # {row.description}" if row.description else ""
        lines.append(f"    {row.key}: {flow(f'<{row.type}>') if row.default is None else row.default}{comment}")
    return "\n".join(lines) + "\n"


def config_rows(config: type[BaseModel]) -> tuple[ConfigRow, ...]:
    """Describe every key of a config, those of the mappings in it as well."""
    root = config_schema(config)
    return tuple(_rows(root, root))


def _rows(schema: Schema, root: Schema, prefix: str = "", depth: int = 0) -> list[ConfigRow]:
    """Return the rows of a mapping, and below each those of the mappings in it, be they in a list.

    A row that only some alternatives of a union have names them at its end.
    """
    options = [option for option in alternatives(schema, root) if "properties" in option]
    if depth == _MAX_DEPTH:
        return []
    tag_key, tags = discriminator(schema, root)
    rows = [ConfigRow(f"{prefix}{tag_key}", listed(tags, "or"), None, "", "which of these")] if tag_key else []
    found: dict[ConfigRow, list[str]] = {}
    for option in options:
        tag = option["properties"].get(tag_key, {}).get("const", option.get("title", ""))
        for key, field in option["properties"].items():
            if key == tag_key:
                continue
            required = key in option.get("required", ())
            default = None if required else flow(field["default"]) if "default" in field else _COMPUTED
            meaning = " ".join(field.get("description", "").split())
            nouns, bounds = zip(*_options(field, root), strict=True)
            row = ConfigRow(f"{prefix}{key}", listed(nouns, "or"), default, listed(filter(None, bounds), "or"), meaning)
            in_list = _rows(subschema(field, 0, root), root, f"{row.key}[].", depth + 1)
            for each in (row, *_rows(field, root, f"{row.key}.", depth + 1), *in_list):
                found.setdefault(each, []).append(str(tag))
    for row, owners in found.items():
        note = "" if len(owners) == len(options) else f" ({listed(owners)})"
        rows.append(replace(row, description=f"{row.description}{note}".strip()))
    return rows


def flow(value: Any) -> str:
    """Write plain data as a line of YAML."""
    if isinstance(value, str):
        plain = _PLAIN_TEXT.fullmatch(value) and value.lower() not in _NOT_PLAIN
        return value if plain else json.dumps(value, ensure_ascii=False)
    if isinstance(value, list):
        return f"[{', '.join(map(flow, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{flow(key)}: {flow(item)}' for key, item in value.items())}}}"
    return word(value)
