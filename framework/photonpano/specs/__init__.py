"""Pipeline specs: YAML with positions, validated models, all problems at once."""

from photonpano.specs.checks import check_stream
from photonpano.specs.json_schema import json_schema
from photonpano.specs.loading import SPEC_SUFFIXES, capture_plan, load_spec, parse_spec
from photonpano.specs.plan import Choice, LevelPlan, Plan
from photonpano.specs.settings import GraphSettings, OutputSettings, RenderSettings, RunSettings

__all__ = [
    "SPEC_SUFFIXES",
    "Choice",
    "GraphSettings",
    "LevelPlan",
    "OutputSettings",
    "Plan",
    "RenderSettings",
    "RunSettings",
    "capture_plan",
    "check_stream",
    "json_schema",
    "load_spec",
    "parse_spec",
]
