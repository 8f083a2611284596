"""The JSON Schema for editors."""

import jsonschema
from pydantic import ConfigDict, Field

from photonpano import Config, MergerContribution
from photonpano.registry import Catalog
from photonpano.specs import json_schema

SPEC = {"version": 1, "source": {"use": "simulator"}}


class Odd:
    """A type of which pydantic knows nothing."""


class OddConfig(Config):
    model_config = ConfigDict(arbitrary_types_allowed=True)

    odd: Odd | None = Field(None, description="no JSON Schema can say this")
    even: int = Field(0, multiple_of=2)


ODD = MergerContribution(name="odd", summary="Toy", config=OddConfig, build=lambda *_: None)


def is_valid(spec, catalog):
    return jsonschema.Draft202012Validator(json_schema(catalog)).is_valid(spec)


def test_json_schema_of_inexpressible_field_checks_other_fields(catalog):
    catalog = Catalog(catalog.rows).including(ODD)
    assert is_valid(SPEC | {"merge": {"use": "odd", "with": {"even": 4}}}, catalog)
    assert not is_valid(SPEC | {"merge": {"use": "odd", "with": {"even": 3}}}, catalog)


def test_json_schema_of_empty_catalog_is_valid_schema():
    jsonschema.Draft202012Validator.check_schema(json_schema(Catalog()))
    assert not is_valid(SPEC, Catalog())
