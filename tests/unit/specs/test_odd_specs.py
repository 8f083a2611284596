"""Odd specs, extreme values and any value at all: a plan, or problems that name every place, in a second."""

import json
import time
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ConfigDict, Field

from photonpano import Config, MergerContribution, SpecError
from photonpano.plugins.contributions import KINDS
from photonpano.plugins.description import config_schema
from photonpano.plugins.registry import Catalog, discover
from photonpano.specs import json_schema, load_spec, parse_spec
from photonpano.specs.settings import GraphSettings, RenderSettings, RunSettings

OUTCOMES = Path(__file__).with_suffix(".txt")
"""What becomes of each: `NAME -> PROBLEM / PROBLEM`, or `NAME -> a plan`."""
BASE = "version: 1\nsource: {use: simulator}\n"
LONGEST_S = 1.0
VALUES: Mapping[str, str] = {
    "nothing": "",
    "empty text": "''",
    "a text of digits": "'3'",
    "a huge number": "1e400",
    "many digits": "9" * 400,
    "NaN": ".nan",
    "an empty list": "[]",
    "an empty mapping": "{}",
    "a mapping": "{a: 1}",
    "a tag": "!!python/object/apply:os.abort []",
    "right to left": "'\u202egnp.exe'",
    "NUL": '"a\\0b"',
}
PLACES: Mapping[str, str] = {
    "version": "version: VALUE\nsource: {use: simulator}\n",
    "source": "version: 1\nsource: VALUE\n",
    "source.use": "version: 1\nsource: {use: VALUE}\n",
    "source.with": "version: 1\nsource: {use: simulator, with: VALUE}\n",
    "levels": BASE + "levels: VALUE\n",
    "run.seed": BASE + "run: {seed: VALUE}\n",
    "output.directory": BASE + "output: {directory: VALUE}\n",
}
DOCUMENTS: Mapping[str, str | bytes] = {
    "two colons": "version:: 1\n",
    "an anchor without value": "version: 1\nsource: &a\nlocate: *a\n",
    "an alias before its anchor": "version: 1\nsource: *a\nlocate: &a direct\n",
    "a merge of itself": "version: 1\nsource: &a {<<: *a}\n",
    "a key of 10,000 letters": BASE + "k" * 10_000 + ": 1\n",
    "a key with a line end": BASE + '"a\\nb": 1\n',
    "1,000 levels": BASE + "levels: [" + "{}, " * 1000 + "]\n",
    "capital letters": "Version: 1\nSOURCE: {Use: simulator}\n",
    "Windows line ends": BASE.replace("\n", "\r\n"),
    "old Macintosh line ends": BASE.replace("\n", "\r"),
    "tabs between": "version:\t1\nsource:\t{use:\tsimulator}\n",
    "a byte order mark": b"\xef\xbb\xbf" + BASE.encode(),
    "UTF-16": BASE.encode("utf-16"),
    "Latin 1": BASE.encode() + b"output: {directory: caf\xe9}\n",
    "a directive": "%YAML 1.1\n---\n" + BASE,
    "a directive of the future": "%YAML 9.9\n---\n" + BASE,
    "an unknown directive": "%FOO\n---\n" + BASE,
    "only a comment": "# nothing\n",
    "only a line": "---\n",
    "a program": "#!/bin/sh\nexit 0\n",
    "JSON": '{"version": 1, "source": {"use": "simulator"}}',
    "JSON with a trap": '{"version": 1, "source": {"use": "simulator"}, "version": 1}',
    "TOML": "version = 1\n[source]\nuse = 'simulator'\n",
    "XML": "<spec><version>1</version></spec>",
    "200 corrections": BASE + "corrections: [" + "rot90, " * 200 + "]\n",
    "1,000 skips": BASE + "graph: {skips: [" + "1, " * 1000 + "]}\n",
}


def specs() -> Iterator[tuple[str, str | bytes]]:
    for place, form in PLACES.items():
        yield from ((f"{place} of {name}", form.replace("VALUE", value)) for name, value in VALUES.items())
    yield from DOCUMENTS.items()


CASES = dict(specs())


def expected() -> dict[str, str]:
    return dict(line.split(" -> ", 1) for line in OUTCOMES.read_text(encoding="utf-8").splitlines())


def test_every_case_has_an_outcome() -> None:
    assert list(expected()) == list(CASES)


@pytest.mark.parametrize("name", CASES)
def test_odd_spec_is_a_plan_or_a_list_of_problems(
    name: str, catalog: Catalog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = CASES[name]
    Path("scan.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    start = time.process_time()
    try:
        load_spec("scan.yaml", catalog=catalog)
        ended = "a plan"
    except SpecError as error:
        ended = " / ".join(str(error).splitlines()).replace(str(tmp_path), "DIR")
    assert time.process_time() - start < LONGEST_S
    assert ended == expected()[name]


SMALL, LARGE = (5e-324, 1e-300, 1e-9), (1e308, 2**31, 2**63, 10**20)


@pytest.fixture(scope="module")
def installed() -> Catalog:
    return discover()


def extremes(field: Mapping[str, Any]) -> Iterator[Any]:
    """Yield the bounds of a key, and numbers near the ends of what numbers can be."""
    for option in (field, *field.get("anyOf", ())):
        if option.get("type") in ("integer", "number"):
            yield from (option[key] for key in option if key.startswith(("minimum", "maximum", "exclusive")))
            yield from (*SMALL, *LARGE)
        if option.get("type") == "array":
            yield from ([], [5e-324] * 3, [1e308], [0.5] * 50)


def extreme_specs(catalog: Catalog) -> Iterator[dict[str, Any]]:
    """Yield sections with one extreme value each."""
    for section, model in {"graph": GraphSettings, "render": RenderSettings, "run": RunSettings}.items():
        for key, field in config_schema(model)["properties"].items():
            yield from ({section: {key: value}} for value in extremes(field))
    for entry in catalog.rows:
        for key, field in config_schema(entry.contribution.config).get("properties", {}).items():
            for value in extremes(field):
                use = {"use": entry.name, "with": {key: value}}
                yield {KINDS[entry.kind].section: [use] if entry.kind == "refiner" else use}


def test_extreme_values_give_plan_or_problems(installed: Catalog, tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", np.zeros((200, 16, 2), np.uint8))
    spec = {"version": 1, "source": {"use": "packed-npy", "with": {"path": str(tmp_path / "cube.npy")}}}
    tried = refused = 0
    for sections in islice(extreme_specs(installed), 0, None, 7):
        tried += 1
        try:
            parse_spec(spec | sections, catalog=installed)
        except SpecError:
            refused += 1
    assert (tried > 100, refused > 25) == (True, True), (tried, refused)


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


@pytest.fixture(scope="module")
def validator(catalog):
    return jsonschema.Draft202012Validator(json_schema(catalog))


@given(path=st.sampled_from(list(paths(SPEC))), value=junk)
def test_any_value_in_spec_gives_plan_or_problems(catalog, validator, path, value):
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
        validator.validate(plan.document)


SIMULATED = {"version": 1, "source": {"use": "simulator"}}


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
    assert is_valid(SIMULATED | {"merge": {"use": "odd", "with": {"even": 4}}}, catalog)
    assert not is_valid(SIMULATED | {"merge": {"use": "odd", "with": {"even": 3}}}, catalog)


def test_json_schema_of_empty_catalog_is_valid_schema():
    jsonschema.Draft202012Validator.check_schema(json_schema(Catalog()))
    assert not is_valid(SIMULATED, Catalog())
