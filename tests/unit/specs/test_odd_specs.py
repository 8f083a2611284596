"""Odd specs, extreme values and any value at all: a plan, or problems that name every place, in a second."""

import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import SpecError
from photonpano.plugins.registry import Catalog
from photonpano.specs import json_schema, load_spec, parse_spec

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


class Odd:
    """A type of which pydantic knows nothing."""
