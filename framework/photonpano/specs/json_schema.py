"""The JSON Schema of specs, with which editors complete names, explain keys and check values."""

from __future__ import annotations

from collections import Counter
from typing import Any, TypeAlias

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from photonpano.corrections import CORRECTIONS
from photonpano.plugins.contributions import KINDS, Kind
from photonpano.plugins.description import TolerantJsonSchema
from photonpano.plugins.registry import Catalog, Entry
from photonpano.specs.components import AUTO, CHAIN, DEFAULT_FALLBACK
from photonpano.specs.settings import (
    LEVELS,
    MAX_LEVELS,
    PANORAMA_ONLY,
    SETTINGS,
    UNTIL_CONVERGED,
    VERSION,
    LevelSettings,
    LightSettings,
    OutputSettings,
    RenderSettings,
    RunSettings,
)

Schema: TypeAlias = dict[str, Any]
MODES = ["auto", "steady", "changing"]  # words that may stand for the section `light`
SECTION = ["object", "null"]  # a section may be left empty
FALLBACK = "the locators to which a lost pair is offered, in order: one or a list, each a name or {use, with}"


def json_schema(catalog: Catalog) -> Schema:
    """Return the JSON Schema (draft 2020-12) of the specs that choose from this catalog.

    A name that two plugins offer is left out, since using it is an error.
    """
    offered = Counter((entry.kind, entry.name) for entry in catalog.rows)
    entries = [entry for entry in catalog.rows if offered[entry.kind, entry.name] == 1 and KINDS[entry.kind].section]
    models: list[type[BaseModel]] = [*(entry.contribution.config for entry in entries), LevelSettings, *SETTINGS.values()]
    models += CORRECTIONS.values()
    unique = dict.fromkeys(models)
    references, schema = models_json_schema([(model, "validation") for model in unique], schema_generator=TolerantJsonSchema)
    definitions: dict[str, Schema] = schema["$defs"]
    schemas: dict[type[BaseModel], Schema] = {model: references[model, "validation"] for model in unique}
    for reference in schemas.values():
        definitions[_definition(reference)]["type"] = SECTION
    definitions[OutputSettings.__name__].pop("required")  # the run folder has a default that depends on the spec's name
    sections, overrides = {}, {}
    for kind in filter(lambda kind: kind.section, KINDS.values()):
        own = [entry for entry in entries if entry.kind == kind.name]
        sections[kind.section] = (
            _component(kind, own, schemas, kind.default) if not kind.meaning else _items(kind, own, schemas)
        )
        if kind.of_level:
            overrides[kind.section] = _component(kind, own, schemas, None)
    definitions["fallback"] = _one_or_list(_item(KINDS["locator"], entries, schemas))
    backends = {"$ref": "#/$defs/fallback", "description": "the locators, in the order in which they are tried"}
    chain = {"type": SECTION, "additionalProperties": False, "properties": {"backends": backends}}
    for section, default in ((sections["locate"], DEFAULT_FALLBACK), (overrides["locate"], "those of `locate`")):
        described = f"{FALLBACK}; by default {default}, but none where `use` is given"
        section["properties"] |= {"fallback": {"$ref": "#/$defs/fallback", "description": described}}
        section["properties"]["use"]["enum"].append(CHAIN)
        chosen = {"properties": {"use": {"const": CHAIN}}, "required": ["use"]}
        section["allOf"] = [*section.get("allOf", ()), {"if": chosen, "then": {"properties": {"with": chain}}}]
    definitions[LevelSettings.__name__]["properties"] |= overrides
    sections["source"]["required"] = ["use"]
    definitions[RunSettings.__name__]["properties"]["executor"] = sections.pop("run.executor")
    definitions[OutputSettings.__name__]["properties"]["formats"] = sections.pop("output.formats")
    rendering, settings = sections.pop("render"), definitions[_definition(schemas[RenderSettings])]
    rendering |= {"description": settings["description"], "properties": rendering["properties"] | settings["properties"]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "photonpano pipeline spec",
        "type": "object",
        "additionalProperties": False,
        "required": ["version", "source"],
        "if": {"anyOf": [{"required": [section]} for section in catalog.run_kinds] or [False]},
        "then": {"properties": dict.fromkeys(PANORAMA_ONLY, False)},
        "properties": {
            "version": {"const": VERSION, "description": "the version of the format"},
            "source": sections.pop("source"),
            "corrections": _corrections(schemas),
            **sections,
            "levels": {
                "description": "how many levels, as many as it takes, or an entry for each level that overrides stages for it",
                "default": LEVELS,
                "anyOf": [
                    {"type": "integer", "minimum": 1, "maximum": MAX_LEVELS},
                    {"const": UNTIL_CONVERGED},
                    {"type": "array", "minItems": 1, "maxItems": MAX_LEVELS, "items": schemas[LevelSettings]},
                ],
            },
            **{name: schemas[model] for name, model in SETTINGS.items()},
            "light": {"anyOf": [{"enum": MODES}, schemas[LightSettings]]},
            "render": rendering,
        },
        "$defs": definitions,
    }


def _definition(reference: Schema) -> str:
    """Return the name of the definition that a reference points to."""
    return str(reference["$ref"]).rpartition("/")[2]


def _component(kind: Kind, entries: list[Entry], schemas: dict[type[BaseModel], Schema], default: str | None) -> Schema:
    """Return the schema of a section that chooses a component; `with` follows what `use` says, or its default."""
    summaries = "\n".join(f"{entry.name}: {entry.contribution.summary}" for entry in entries)
    bindings = []
    for entry in entries:
        config = entry.contribution.config
        chosen: Schema = {"properties": {"use": {"const": entry.name}}}
        if entry.name != default:
            chosen["required"] = ["use"]
        bound: Schema = {"properties": {"with": schemas[config]}}
        if any(field.is_required() for field in config.model_fields.values()):
            bound["required"] = ["with"]
        bindings.append({"if": chosen, "then": bound})
    use: Schema = {"enum": [entry.name for entry in entries], "description": f"the {kind.name}:\n{summaries}"}
    if default is not None:
        use["default"] = default
    keys = {"use": use, "with": {"type": SECTION, "description": f"the keys of the {kind.name}"}}
    section: Schema = {"type": SECTION, "additionalProperties": False, "properties": keys}
    return section | {"allOf": bindings} if bindings else section


def _item(kind: Kind, entries: list[Entry], schemas: dict[type[BaseModel], Schema]) -> Schema:
    """Return the schema of one component of a list: a name, or a mapping."""
    own = [entry for entry in entries if entry.kind == kind.name]
    component = _component(kind, own, schemas, None) | {"type": "object", "required": ["use"]}
    return {"anyOf": [component["properties"]["use"], component]}


def _one_or_list(item: Schema) -> Schema:
    """Return the schema of a list of components, for which one alone may stand."""
    return {"anyOf": [*item["anyOf"], {"type": "array", "items": item}, {"type": "null"}]}


def _items(kind: Kind, entries: list[Entry], schemas: dict[type[BaseModel], Schema]) -> Schema:
    """Return the schema of a section in which components stand by name, or as mappings."""
    item = _item(kind, entries, schemas)
    meaning = f"{kind.meaning}; by default {kind.default}" if kind.default else kind.meaning
    return {"description": meaning} | (_one_or_list(item) if kind.several else item)


def _corrections(schemas: dict[type[BaseModel], Schema]) -> Schema:
    alone = [name for name, model in CORRECTIONS.items() if not any(key.is_required() for key in model.model_fields.values())]
    one = {
        "type": "object",
        "minProperties": 1,
        "maxProperties": 1,
        "additionalProperties": False,
        "properties": {name: schemas[model] for name, model in CORRECTIONS.items()},
    }
    return {
        "description": "what is done to frames first of all, in this order: names, or mappings of one name to its settings; "
        "auto masks what stands still in the frame and divides by a vignette, and an empty list does nothing",
        "default": AUTO,
        "anyOf": [{"enum": [AUTO, None]}, {"type": "array", "items": {"anyOf": [{"enum": alone}, one]}}],
    }
