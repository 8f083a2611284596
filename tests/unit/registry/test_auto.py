"""All sources are asked whose capture a path is; one that fails keeps none of the others from answering."""

from pathlib import Path

import pytest

from photonpano import Config, PluginError, Recognised, SourceContribution
from photonpano.registry import Catalog, Origin
from photonpano.registry.auto import AUTO, AutoConfig, ask_sources
from photonpano.registry.catalog import make_entry

CUBE = Path("cube.dat")


class NoKeys(Config):
    """None."""


def source(name, recognise):
    contribution = SourceContribution(name=name, summary="Toy", config=NoKeys, build=lambda *_: None, recognise=recognise)
    return make_entry(contribution, Origin("toys", "1.2", "toys = toys.hooks"))


def raises(path):
    raise LookupError(f"{path.name} is not to my taste")


def test_who_recognises_a_path_is_told_with_the_reason():
    yes = Recognised({"path": CUBE}, "it smells of it")
    catalog = Catalog((source("no", lambda _: None), source("yes", lambda path: yes if path == CUBE else None)))
    answers = ask_sources(catalog, CUBE)
    assert [(entry.name, answer) for entry, answer in answers.recognised] == [("yes", yes)]
    assert answers.failures == ()
    assert ask_sources(catalog, Path("other.dat")).recognised == ()


def test_one_that_fails_is_named_and_stops_no_other():
    catalog = Catalog(
        (
            source("alpha", raises),
            source("beta", lambda _: {"path": CUBE}),
            source("gamma", lambda _: Recognised({}, "it is all I know")),
        )
    )
    answers = ask_sources(catalog, CUBE)
    assert [entry.name for entry, _ in answers.recognised] == ["gamma"]
    assert answers.failures == (
        "recognise of the source 'alpha' of toys 1.2 raised LookupError: cube.dat is not to my taste",
        "recognise of the source 'beta' of toys 1.2 returned a dict, expected a Recognised or None",
    )


def test_nothing_is_built_of_auto():
    with pytest.raises(PluginError, match=r"^auto stands for the source that recognises a path: "):
        AUTO.build(AutoConfig(path=CUBE), None)
