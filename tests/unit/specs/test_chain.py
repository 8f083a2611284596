"""A chain of locators is written as one locator, and means one with fallbacks."""

import pytest

from photonpano import PluginError, SpecError
from photonpano.specs import builtin, parse_spec

MINIMAL = {"version": 1, "source": {"use": "simulator"}}
SHORT = {"use": "direct", "with": {"max_steps": 5}}
CLEAR = {"use": "opencv-sift", "with": {"ratio": 0.6}}


def chain(*backends):
    return {"use": "chain-of-backends", "with": {"backends": list(backends)}}


def document(catalog, **sections):
    return parse_spec(MINIMAL | sections, catalog=catalog).document


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        (chain(SHORT, "opencv-sift", CLEAR), SHORT | {"fallback": ["opencv-sift", CLEAR]}),
        (chain("opencv-sift"), {"use": "opencv-sift"}),
        (chain("opencv-sift", "direct"), {"use": "opencv-sift", "fallback": "direct"}),
        ({"use": "chain-of-backends"}, {"use": "direct", "fallback": "opencv-sift"}),
        ({"use": "chain-of-backends", "with": None}, {"use": "direct", "fallback": "opencv-sift"}),
    ],
)
def test_chain_of_backends_equals_locator_with_fallbacks(written, meant, catalog):
    assert document(catalog, locate=written) == document(catalog, locate=meant)
    level = {"locate": CLEAR}
    assert document(catalog, locate=CLEAR, levels=[level | {"locate": written}]) == document(
        catalog, locate=CLEAR, levels=[level | {"locate": meant}]
    )


def test_level_inherits_first_locator_and_fallbacks_of_chain(catalog):
    levels = [{"locate": {"with": {"max_steps": 9}}}, {"locate": {"fallback": []}}]
    assert document(catalog, locate=chain("direct", CLEAR), levels=levels) == document(
        catalog, locate={"use": "direct", "fallback": CLEAR}, levels=levels
    )


def test_chain_without_keys_equals_defaults(catalog):
    plan = parse_spec(MINIMAL, overrides=["locate.use=chain-of-backends"], catalog=catalog)
    assert plan.document == document(catalog)


def test_places_of_chain_have_paths_of_resolved_document(catalog):
    spec = (
        "version: 1\nsource: {use: simulator}\nlocate:\n  use: chain-of-backends\n  with:\n    backends:\n"
        "      - {use: direct, with: {max_steps: 5}}\n      - opencv-sift\n"
        "levels:\n  - {locate: {use: chain-of-backends}}"
    )
    places = parse_spec(spec, catalog=catalog).places
    wanted = ["locate", "locate.use", "locate.with.max_steps", "locate.fallback.0", "levels.0.locate.use"]
    assert [(places[path].line, places[path].column) for path in wanted] == [(7, 9), (7, 10), (7, 30), (8, 9), (10, 15)]


def test_default_chain_with_uninstalled_locator_is_an_error_at_its_name(catalog):
    rows = tuple(entry for entry in catalog.rows if entry.name != "opencv-sift")
    with pytest.raises(SpecError) as caught:
        parse_spec("version: 1\nsource: {use: simulator}\nlocate: {use: chain-of-backends}", catalog=type(catalog)(rows))
    assert str(caught.value).startswith("3:15: locate.use: there is no locator 'opencv-sift'; known: ")


def test_building_an_alias_is_an_error():
    for alias in (*builtin.photonpano_sources(), *builtin.photonpano_locators()):
        with pytest.raises(PluginError, match=r"^this name stands for other components, "):
            alias.build(None, None)
