"""Whatever is written into a spec: a plan, or problems with a place; never another error."""

import json

import jsonschema
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import SpecError
from photonpano.specs import json_schema, parse_spec

SPEC = {
    "version": 1,
    "source": {"use": "simulator", "with": {"n_frames": 10, "size": [3, 4], "flip": {"rows": True}}},
    "resample": {"use": "midpoint", "with": {"group_size": 5, "stride": 2}},
    "locate": {"with": {"max_steps": 7}, "fallback": ["opencv-sift", {"use": "opencv-sift", "with": {"ratio": 0.9}}]},
    "refine": ["drift", {"use": "short-spans", "with": {"span_frames": 4}}],
    "levels": [{"scale": 0.5, "locate": {"use": "direct", "with": {"max_steps": 3}, "fallback": "opencv-sift"}}, {}],
    "graph": {"skips": [1.0, 2.0], "disconnected": "largest"},
    "render": {"scale": 2.0, "reference": "first"},
    "output": {"directory": "out"},
    "run": {"seed": 1, "threads": 2, "memory": "1 GiB"},
}


def paths(data, path=()):
    yield path
    children = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in children:
        yield from paths(value, (*path, key))


def replaced(data, path, value):
    if not path:
        return value
    copy = dict(data) if isinstance(data, dict) else list(data)
    copy[path[0]] = replaced(copy[path[0]], path[1:], value)
    return copy


words = st.sampled_from(["use", "with", "simulator", "direct", "twice", "kornia-loftr", "ratio", "scale", "first", "\0", ""])
junk = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | st.floats() | words,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)


@settings(deadline=None)  # the machine may be busy
@given(path=st.sampled_from(list(paths(SPEC))), value=junk)
def test_any_value_in_spec_gives_plan_or_problems(catalog, path, value):
    spec = replaced(SPEC, path, value)
    problems = []
    try:
        plan = parse_spec(json.dumps(spec), catalog=catalog)
    except SpecError as error:
        problems = error.problems
    if problems:
        assert all(problem.line and problem.column for problem in problems)
        with pytest.raises(SpecError):
            parse_spec(spec, catalog=catalog)
    else:
        assert parse_spec(plan.document, catalog=catalog).document == plan.document
        jsonschema.validate(plan.document, json_schema(catalog))
