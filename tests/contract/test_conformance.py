"""Every component that comes with photonpano is tested with the conformance kit."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from photonpano import discover
from photonpano.specs import builtin
from photonpano.testing.conformance import Conformance

(AUTO,) = builtin.photonpano_sources()
(CHAIN,) = builtin.photonpano_locators()
PLUGINS = Path(__file__).parents[1] / "plugins"
OURS = [(entry.kind, entry.name) for entry in discover().rows if entry.origin.plugin == "photonpano"]


@pytest.fixture(scope="module")
def tested() -> set[tuple[str, str]]:
    """Return kind and name of all contributions under test in a class of the kit."""
    found = {(own.kind, own.name) for own in (AUTO, CHAIN)}
    for path in PLUGINS.glob("*/test_conformance.py"):
        spec = importlib.util.spec_from_file_location(f"conformance_of_{path.parent.name}", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        for name, value in vars(module).items():
            if name.startswith("Test") and isinstance(value, type) and issubclass(value, Conformance):
                found.add((value.contribution.kind, value.contribution.name))
    return found


@pytest.mark.parametrize(("kind", "name"), OURS)
def test_own_components_have_conformance_tests(kind: str, name: str, tested: set[tuple[str, str]]) -> None:
    assert (kind, name) in tested, f"add a subclass of {kind.capitalize()}Conformance to tests/plugins/*/test_conformance.py"


class TestChainOfBackends(Conformance):
    """It stands for other locators, which a spec that names it builds in its place: only what holds without building holds."""

    kind = "locator"
    contribution = CHAIN


class TestAuto(Conformance):
    """It stands for the source that recognises a path; the same holds."""

    kind = "source"
    contribution = AUTO
    config = {"path": "capture.npy"}
