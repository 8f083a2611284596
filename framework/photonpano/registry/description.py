"""Describe a component for somebody who wants to use it in a spec."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from photonpano.registry.kinds import KINDS
from photonpano.registry.schema_text import (
    alternative,
    alternatives,
    bounds_words,
    config_schema,
    discriminator,
    expectation,
    type_words,
    word,
)
from photonpano.text import listed

if TYPE_CHECKING:
    from collections.abc import Iterator

    from pydantic import BaseModel

    from photonpano.contributions import Contribution
    from photonpano.registry.schema_text import Schema

PLAIN_TEXT = re.compile(r"[A-Za-z/][\w./-]*")
COMPUTED = "computed"
"""What stands for a default that only the config itself can tell."""
MAX_DEPTH = 4
"""A config may contain itself; mappings are described down to here."""
NOT_PLAIN = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}


@dataclass(frozen=True, slots=True)
class ConfigRow:
    """One key of a config, in words.

    Attributes:
        key: the key under `with`; that of a mapping in a mapping with dots, such as `filter.size`.
        type: such as "integer" or "first, last or number".
        default: as it is written in YAML, or "computed"; None if the key is required.
        bounds: such as "at least 1"; empty if there are none.
        description: what the key means.
    """

    key: str
    type: str
    default: str | None
    bounds: str
    description: str


@dataclass(frozen=True, slots=True)
class Description:
    """What `describe` tells of a component.

    Attributes:
        kind: such as "locator".
        name: what specs call it.
        summary: one line.
        rows: the keys of its config.
        snippet: its section of a spec with its defaults, to paste; what is required stands there as `<...>`.
    """

    kind: str
    name: str
    summary: str
    rows: tuple[ConfigRow, ...]
    snippet: str


def describe(contribution: Contribution) -> Description:
    """Describe a component: a table of its config, and a snippet of YAML to paste."""
    root = config_schema(contribution.config)
    snippet = [f"{KINDS[contribution.kind].section}:", f"  use: {contribution.name}"]
    if root.get("properties"):
        snippet += ["  with:", *_lines(root, {}, root, "    ")]
    return Description(
        contribution.kind,
        contribution.name,
        contribution.summary,
        config_rows(contribution.config),
        "\n".join(snippet) + "\n",
    )


def config_rows(config: type[BaseModel]) -> tuple[ConfigRow, ...]:
    """Describe every key of a config, those of the mappings in it as well."""
    root = config_schema(config)
    return tuple(_rows(root, root))


def _rows(schema: Schema, root: Schema, prefix: str = "", depth: int = 0) -> list[ConfigRow]:
    """Return the rows of a mapping, and below each those of the mappings in it.

    A row that only some alternatives of a union have names them at its end.
    """
    options = [option for option in alternatives(schema, root) if "properties" in option]
    if depth == MAX_DEPTH:
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
            default = None if required else flow(field["default"]) if "default" in field else COMPUTED
            row = ConfigRow(f"{prefix}{key}", type_words(field, root), default, bounds_words(field, root), _meaning(field))
            for each in (row, *_rows(field, root, f"{row.key}.", depth + 1)):
                found.setdefault(each, []).append(str(tag))
    for row, owners in found.items():
        note = "" if len(owners) == len(options) else f" ({listed(owners)})"
        rows.append(replace(row, description=f"{row.description}{note}".strip()))
    return rows


def _lines(schema: Schema, value: dict[str, Any], root: Schema, indent: str) -> Iterator[str]:
    """Write a mapping as YAML: what the value says, else the default, else what is expected."""
    fields = schema["properties"]
    for key in sorted(fields, key=lambda key: "const" not in fields[key]):  # first the key that tells a union apart
        field = fields[key]
        default = value.get(key, field.get("default"))
        comment = f"  # {_meaning(field)}" if _meaning(field) else ""
        if key in schema.get("required", ()) and key not in value:
            yield f"{indent}{key}: {flow(f'<{expectation(field, root)}>')}{comment}"
        elif isinstance(default, dict) and "properties" in (inner := _alternative_of(field, default, root)):
            yield f"{indent}{key}:{comment}"
            yield from _lines(inner, default, root, f"{indent}  ")
        elif key in value or "default" in field:
            yield f"{indent}{key}: {flow(default)}{comment}"


def _alternative_of(schema: Schema, value: dict[str, Any], root: Schema) -> Schema:
    tag_key, _ = discriminator(schema, root)
    return alternative(schema, value.get(tag_key or ""), root)


def _meaning(schema: Schema) -> str:
    return " ".join(schema.get("description", "").split())


def flow(value: Any) -> str:
    """Write plain data as a line of YAML."""
    if isinstance(value, str):
        plain = PLAIN_TEXT.fullmatch(value) and value.lower() not in NOT_PLAIN
        return value if plain else json.dumps(value, ensure_ascii=False)
    if isinstance(value, list):
        return f"[{', '.join(map(flow, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{flow(key)}: {flow(item)}' for key, item in value.items())}}}"
    return word(value)
