"""The JSON Schema for editors."""

import jsonschema
import pytest
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


@pytest.mark.parametrize(
    ("change", "valid"),
    [
        ({}, True),
        ({"locate": {"with": {"max_steps": 5}}}, True),
        ({"locate": {"with": {"ratio": 0.5}}}, False),
        ({"locate": {"use": "opencv-sift", "with": {"ratio": 0.5}}}, True),
        ({"locate": {"use": "opencv-sift", "with": {"max_steps": 5}}}, False),
        ({"locate": {"use": "kornia-loftr"}}, False),
        ({"locate": {"use": "twice"}}, False),
        ({"levels": [{"locate": {"with": {"max_steps": 5}}}]}, True),
        ({"levels": [{"locate": {"use": "opencv-sift", "with": {"max_steps": 5}}}]}, False),
        ({"levels": [{"source": {"use": "simulator"}}]}, False),
        ({"levels": "until-converged"}, True),
        ({"levels": "until-convergd"}, False),
        ({"output": {}}, True),
        ({"locate": {"fallback": "direct"}}, True),
        ({"locate": {"fallback": ["direct", {"use": "opencv-sift", "with": {"ratio": 0.9}}]}}, True),
        ({"locate": {"fallback": "twice"}}, False),
        ({"locate": {"fallback": {"use": "direct", "with": {"ratio": 0.5}}}}, False),
        ({"locate": {"fallback": [{"with": {"ratio": 0.5}}]}}, False),
        ({"locate": {"fallback": [{"use": "direct", "fallback": "opencv-sift"}]}}, False),
        ({"refine": "drift"}, True),
        ({"refine": {"use": "drift", "with": {"knots": 5}}}, True),
        ({"refine": ["short-spans", {"use": "drift"}]}, True),
        ({"refine": []}, True),
        ({"refine": None}, True),
        ({"refine": "photon-mle"}, False),
        ({"refine": {"with": {"knots": 5}}}, False),
        ({"refine": [{"use": "drift", "with": {"span_frames": 5}}]}, False),
        ({"levels": [{"refine": "drift"}]}, False),
        ({"locate": {"use": "chain-of-backends"}}, True),
        ({"locate": {"use": "chain-of-backends", "with": {"backends": ["direct", {"use": "opencv-sift"}]}}}, True),
        ({"locate": {"use": "chain-of-backends", "with": {"backends": [{"use": "direct", "with": {"ratio": 0.5}}]}}}, False),
        ({"locate": {"use": "chain-of-backends", "with": {"backends": ["chain-of-backends"]}}}, False),
        ({"locate": {"use": "chain-of-backends", "with": {"backends": []}}}, False),
        ({"locate": {"fallback": "chain-of-backends"}}, False),
        ({"merge": {"fallback": "photon-mle"}}, False),
        ({"source": {"use": "auto", "with": {"path": "cube.npy", "frame_rate_hz": 96800}}}, True),
        ({"source": {"use": "auto", "with": {"frame_rate_hz": 96800}}}, False),
        ({"levels": [{"locate": {"fallback": "direct"}}]}, True),
        ({"source": {"with": {"flux": 1}}}, False),
        ({"corrections": ["rot90", {"crop": {"rows": [2, None]}}, {"rot180": None}]}, True),
        ({"corrections": None}, True),
        ({"corrections": ["rot45"]}, False),
        ({"corrections": ["mask"]}, False),
        ({"corrections": [{"mask": {}}]}, False),
        ({"corrections": [{"rot90": None, "flip-ud": None}]}, False),
        ({"corrections": {"rot90": None}}, False),
    ],
)
def test_json_schema_binds_keys_to_component(change, valid, catalog):
    assert is_valid(SPEC | change, catalog) == valid


def test_json_schema_of_inexpressible_field_checks_other_fields(catalog):
    catalog = Catalog(catalog.rows).including(ODD)
    assert is_valid(SPEC | {"merge": {"use": "odd", "with": {"even": 4}}}, catalog)
    assert not is_valid(SPEC | {"merge": {"use": "odd", "with": {"even": 3}}}, catalog)


def test_json_schema_of_empty_catalog_is_valid_schema():
    jsonschema.Draft202012Validator.check_schema(json_schema(Catalog()))
    assert not is_valid(SPEC, Catalog())
