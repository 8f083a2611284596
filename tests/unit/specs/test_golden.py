"""Specs that are right, and the exact messages for those that are wrong."""

import json
from pathlib import Path

import jsonschema
import pytest
from ruamel.yaml import YAML, YAMLError

from photonpano import SpecError
from photonpano.specs import json_schema, load_spec, parse_spec

SPECS = Path(__file__).parents[2] / "specs"
GOOD = sorted((SPECS / "good").glob("*.yaml"))
BAD = sorted((SPECS / "bad").glob("*.yaml"))
BEYOND_A_SCHEMA = {
    "fallback_again",
    "lens_of_homographies",
    "projection_of_homographies",
    "source_check",
    "start_of_rotations",
    "surrogate",
    "validator",
}
"""What is wrong here is not wrong by its shape; the files that are no YAML are left out by themselves."""


def name(path):
    return path.stem


def data(path):
    """Return what an editor sees, None where there is no document to check."""
    try:
        return YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except (YAMLError, UnicodeDecodeError, ValueError, TypeError, RecursionError):
        return None


@pytest.fixture(scope="module")
def validator(catalog):
    schema = json_schema(catalog)
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("path", BAD, ids=name)
def test_bad_spec_gives_exactly_these_messages(path, catalog, monkeypatch):
    monkeypatch.chdir(path.parent)
    with pytest.raises(SpecError) as caught:
        load_spec(path.name, catalog=catalog)
    assert f"{caught.value}\n" == path.with_suffix(".txt").read_text(encoding="utf-8")
    assert {problem.file for problem in caught.value.problems} == {Path(path.name)}


@pytest.mark.parametrize("path", GOOD, ids=name)
def test_good_spec_resolves_to_document_that_resolves_to_itself(path, catalog, validator):
    plan = load_spec(path, catalog=catalog)
    again = parse_spec(json.loads(json.dumps(plan.document)), catalog=catalog)
    assert again.document == plan.document
    assert (
        again.source,
        again.corrections,
        again.levels,
        again.refine,
        again.graph,
        again.render,
        again.output,
        again.run,
    ) == ((plan.source, plan.corrections, plan.levels, plan.refine, plan.graph, plan.render, plan.output, plan.run))
    validator.validate(plan.document)


@pytest.mark.parametrize("path", GOOD, ids=name)
def test_good_spec_is_valid_for_editors(path, validator):
    validator.validate(data(path))


@pytest.mark.parametrize("path", BAD, ids=name)
def test_bad_spec_is_marked_by_editors(path, validator):
    document = data(path)
    if document is not None:
        assert validator.is_valid(document) == (path.stem in BEYOND_A_SCHEMA)
