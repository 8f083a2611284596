"""Describe a component for somebody who wants to use it in a spec."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from photonpano.registry.kinds import KINDS
from photonpano.registry.wording import bounds_words, config_schema, expectation, type_words, word

if TYPE_CHECKING:
    from photonpano.contributions import AnyContribution
    from photonpano.registry.wording import Schema

PLAIN_TEXT = re.compile(r"[A-Za-z/][\w./-]*")
NOT_PLAIN = {"true", "false", "null", "yes", "no", "on", "off", "y", "n"}


@dataclass(frozen=True, slots=True)
class ConfigRow:
    """One key of a config, in words.

    Attributes:
        key: the key under `with`.
        type: such as "integer" or "first, last or number".
        default: as it is written in YAML; None if the key is required.
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
        snippet: its section of a spec with all defaults, to paste; what is required stands there as `<...>`.
        install: what to pass to `pip install` for the libraries that it needs.
    """

    kind: str
    name: str
    summary: str
    rows: tuple[ConfigRow, ...]
    snippet: str
    install: tuple[str, ...]


def describe(contribution: AnyContribution) -> Description:
    """Describe a component: a table of its config, and a snippet of YAML to paste."""
    root = config_schema(contribution.config)
    fields: dict[str, Any] = root.get("properties", {})
    required = root.get("required", [])
    rows = tuple(_row(key, schema, key in required, root) for key, schema in fields.items())
    placeholders = {key: flow(f"<{expectation(fields[key], root)}>") for key in required}
    return Description(
        contribution.kind,
        contribution.name,
        contribution.summary,
        rows,
        _snippet(KINDS[contribution.kind].section, contribution.name, rows, placeholders),
        tuple(dict.fromkeys(requirement.install for requirement in contribution.requires)),
    )


def _row(key: str, schema: Schema, required: bool, root: Schema) -> ConfigRow:
    default = None if required else flow(schema.get("default"))
    description = " ".join(schema.get("description", "").split())
    return ConfigRow(key, type_words(schema, root), default, bounds_words(schema, root), description)


def _snippet(section: str, name: str, rows: tuple[ConfigRow, ...], placeholders: dict[str, str]) -> str:
    lines = [f"{section}:", f"  use: {name}"]
    if rows:
        lines.append("  with:")
    for row in rows:
        value = placeholders[row.key] if row.default is None else row.default
        comment = f"  # {row.description}" if row.description else ""
        lines.append(f"    {row.key}: {value}{comment}")
    return "\n".join(lines) + "\n"


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
