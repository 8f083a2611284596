"""Pipeline specs: YAML with positions, validated models, all problems at once."""

from photonpano.spec.checks import check_stream
from photonpano.spec.json_schema import json_schema
from photonpano.spec.loading import load_spec, parse_spec
from photonpano.spec.plan import Choice, LevelPlan, Plan
from photonpano.spec.settings import GraphSettings, OutputSettings, RenderSettings, RunSettings

__all__ = [
    "Choice",
    "GraphSettings",
    "LevelPlan",
    "OutputSettings",
    "Plan",
    "RenderSettings",
    "RunSettings",
    "check_stream",
    "json_schema",
    "load_spec",
    "parse_spec",
]
