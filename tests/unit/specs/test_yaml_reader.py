"""YAML, read into plain values with their places."""

import string

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from photonpano.specs.yaml_reader import Place, read_yaml


def read(text):
    problems = []
    value = read_yaml(text, Place(), problems)
    assert problems == []
    return value


def places(text):
    return {value.place.where: value.place for value in read(text).all()}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("on", "on"),
        ("yes", "yes"),
        ("True", True),
        ("false", False),
        ("~", None),
        ("1e3", 1000),
        ("1E+3", 1000),
        ("1e30", 1e30),
        ("-2e2", -200),
        ("1.0e3", 1000.0),
        ("1e-3", 0.001),
        ("0.5  ", 0.5),
        ("1_000", 1000),
        ("0x1F", 31),
        ("0o17", 15),
        ("007", 7),
        ("+5", 5),
        (".5", 0.5),
        ("-.inf", float("-inf")),
        ("2 GiB", "2 GiB"),
        ("'5'", "5"),
        ("2020-01-01", "2020-01-01"),
        ("1:30", "1:30"),
        ("!!str 5", "5"),
        ("!!float 5", 5.0),
        ("=", "="),
        ("|\n  a\n  b\n", "a\nb\n"),
        ("{}", {}),
        ("{a: &x [1], b: *x}", {"a": [1], "b": [1]}),
        ("a: &x {p: 1, q: 2}\nb: {<<: *x, q: 3}", {"a": {"p": 1, "q": 2}, "b": {"p": 1, "q": 3}}),
        ("{<<: [{a: 1}, {a: 2, b: 3}], c: 4}", {"a": 1, "b": 3, "c": 4}),
        ("&x 1", 1),
        ("123456789012345678901234567890", 123456789012345678901234567890),
        ("{a: &x 1, b: &x 2, c: *x}", {"a": 1, "b": 2, "c": 2}),
    ],
)
def test_yaml_scalar_gives_value(text, value):
    plain = read(text).plain()
    assert plain == value
    assert type(plain) is type(value)


def test_places_of_values_and_keys():
    found = places("a: 1\nb:\n  - x: {y: 2}\n  -\nc:\n")
    assert {where: (place.line, place.column, place.start) for where, place in found.items()} == {
        "": (1, 1, None),
        "a": (1, 1, (1, 4)),
        "b": (2, 1, (3, 3)),
        "b.0": (3, 5, None),
        "b.0.x": (3, 5, (3, 8)),
        "b.0.x.y": (3, 9, (3, 12)),
        "b.1": (4, 4, None),
        "c": (5, 1, None),
    }


def test_merged_keys_have_places_where_they_are_written():
    found = places("a: &x {p: {r: 1}, q: {r: 2}}\nb: {<<: *x, q: {s: 3}}")
    assert {where: place.line for where, place in found.items() if where.startswith("b.")} == {
        "b.p": 1,
        "b.p.r": 1,
        "b.q": 2,
        "b.q.s": 2,
    }


@given(st.text(string.ascii_letters + string.digits + " \n:-[]{},&*!|>'\"#%@`?<", max_size=40))
def test_any_text_gives_value_or_problem(text):
    problems = []
    if read_yaml(text, Place(), problems).data is None and not problems:
        assert YAML(typ="safe", pure=True).load(text) is None
    for problem in problems:
        assert problem.line is None or problem.line <= text.count("\n") + 2
