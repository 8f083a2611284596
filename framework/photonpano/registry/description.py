"""Describe a component for somebody who wants to use it in a spec."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from photonpano.contributions import KINDS
from photonpano.registry.schema_text import (
    alternatives,
    bounds_words,
    config_schema,
    discriminator,
    subschema,
    type_words,
    word,
)
from photonpano.text import listed

if TYPE_CHECKING:
    from pydantic import BaseModel

    from photonpano.contributions import Contribution
    from photonpano.registry.schema_text import Schema

_PLAIN_TEXT = re.compile(r"[A-Za-z/][\w./-]*")
_NOT_PLAIN = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}
_COMPUTED = "computed"  # stands for a default that only the config itself can compute
_MAX_DEPTH = 4  # the depth down to which the mappings of a config, which may contain itself, are described


@dataclass(frozen=True, slots=True)
class ConfigRow:
    """One key of a config, in words.

    Attributes:
        key: the key under `with`; that of a mapping in a mapping with dots, such as `filter.size`, and that of a mapping in a
            list with brackets, such as `filters[].size`.
        type: such as "integer" or "first, last or number".
        default: as it is written in YAML, or "computed"; None if the key is required.
        bounds: such as "at least 1"; empty if there are none.
    """

    key: str
    type: str
    default: str | None
    bounds: str
    description: str


def snippet(contribution: Contribution) -> str:
    """Return the section of a spec that uses a component, with all defaults; a key that is required has a value `<...>`."""
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
            row = ConfigRow(f"{prefix}{key}", type_words(field, root), default, bounds_words(field, root), meaning)
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
