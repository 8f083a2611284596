"""Resolve the list of corrections: each a name, or a mapping of one name to its settings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from photonpano.corrections import CORRECTIONS
from photonpano.reading import missing_file
from photonpano.specs.tree import Value, given, joined
from photonpano.specs.validation import validate
from photonpano.text import suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pydantic import BaseModel

    from photonpano.corrections import Correction
    from photonpano.errors import Problem

Schema = dict[str, Any]


def resolved_corrections(section: Value, directory: Path, problems: list[Problem]) -> tuple[Correction, ...]:
    """Resolve the section `corrections`.

    Args:
        section: a list; null counts as an empty one.
        directory: what relative paths count from.
        problems: what is wrong is added here, each at its place.
    """
    content = [] if section.content is None else section.content
    if not isinstance(content, list):
        problems.append(section.place.problem(f"expected a list of corrections, got {given(content)}"))
        return ()
    found = (_resolved(item, directory, problems) for item in content)
    return tuple(correction for correction in found if correction is not None)


def written_corrections(corrections: Iterable[Correction]) -> list[Any]:
    """Write corrections down as plain data, from which they can be resolved again."""
    settings = ((each.name, each.model_dump(mode="json")) for each in corrections)
    return [{name: keys} if keys else name for name, keys in settings]


def corrections_schema(schemas: dict[type[BaseModel], Schema]) -> Schema:
    """Return the JSON Schema of the section.

    Args:
        schemas: a reference for the model of each correction.
    """
    alone = [name for name, model in CORRECTIONS.items() if not any(key.is_required() for key in model.model_fields.values())]
    one = {
        "type": "object",
        "minProperties": 1,
        "maxProperties": 1,
        "additionalProperties": False,
        "properties": {name: schemas[model] for name, model in CORRECTIONS.items()},
    }
    return {
        "description": "what is done to frames first of all, in this order: names, or mappings of one name to its settings",
        "type": ["array", "null"],
        "items": {"anyOf": [{"enum": alone}, one]},
    }


def _resolved(item: Value, directory: Path, problems: list[Problem]) -> Correction | None:
    """Resolve one correction; None if something is wrong."""
    content = item.content
    if isinstance(content, str):
        name, at = content, item.place
        settings = Value({}, replace(at, where=joined(at.where, name)))
    elif isinstance(content, dict) and len(content) == 1:
        ((name, settings),) = content.items()
        at = settings.head
    else:
        got = f"a mapping of {len(content)}" if isinstance(content, dict) else given(content)
        expected = "the name of a correction, or a mapping of one name to its settings such as {crop: {rows: [2, null]}}"
        problems.append(item.place.problem(f"expected {expected}, got {got}"))
        return None
    if name not in CORRECTIONS:
        problems.append(at.problem(f"there is no correction {name!r}; {suggestion(name, CORRECTIONS)}"))
        return None
    correction = validate(CORRECTIONS[name], settings, directory, problems)
    for key, file in correction or ():
        if isinstance(file, Path) and not file.exists():
            place = settings.content[key].place if isinstance(settings.content, dict) else at
            problems.append(place.problem(missing_file(file)))
    return correction
