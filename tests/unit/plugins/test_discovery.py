"""Discovery of plugins: working, broken, disabled, and with conflicting names."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest

from photonpano import PluginError
from photonpano.plugins.registry import BrokenPlugin, DisabledPlugin, Origin, discover

HEADER = """
from photonpano import *

class Keys(Config):
    pass

def unbuilt(config, context):
    raise AssertionError("nothing is built during discovery")

def source(name, **more):
    return SourceContribution(name=name, summary="A toy", config=Keys, build=unbuilt, **more)

def locator(name, **more):
    return LocatorContribution(name=name, summary="A toy", config=Keys, build=unbuilt, **more)
"""


@pytest.fixture
def install(tmp_path, monkeypatch) -> Callable[..., None]:
    """Install a distribution with one hook module: `install("alpha", "1.0", "code of the hook module")`."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv("PHOTONPANO_DISABLE_PLUGINS", raising=False)

    def install(name: str, version: str, code: str, metadata: bool = True, distribution: str = "") -> None:
        module = f"{name}_hooks"
        monkeypatch.delitem(sys.modules, module, raising=False)
        (tmp_path / f"{module}.py").write_text(HEADER + dedent(code))
        distribution = distribution or name
        info = tmp_path / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "entry_points.txt").write_text(f"[photonpano]\n{name} = {module}\n")
        if metadata:
            (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
        importlib.invalidate_caches()

    yield install
    for module in [each for each in sys.modules if each.endswith("_hooks")]:
        del sys.modules[module]


GOOD = """
@hookimpl
def photonpano_sources():
    yield source("toy-camera")

@hookimpl
def photonpano_locators():
    return [locator("toy-locator"), locator("another")]
"""


# Hook modules that are broken, and what is said of each.
BROKEN = [
    block.rstrip("\n").split("\n-> ")
    for block in Path(__file__).with_name("broken_plugins.txt").read_text(encoding="utf-8").split("\n\n")
]


def of_toys(rows):
    """Leave out what is really installed."""
    return [row for row in rows if row.origin.entry_point.endswith("_hooks")]


def test_good_plugin_is_on_offer_with_its_distribution(install):
    install("alpha", "1.2", GOOD)
    catalog = discover()
    rows = [
        (row.kind, row.name, row.origin.plugin, row.origin.version, row.origin.entry_point) for row in of_toys(catalog.rows)
    ]
    assert rows == [
        ("source", "toy-camera", "alpha", "1.2", "alpha = alpha_hooks"),
        ("locator", "another", "alpha", "1.2", "alpha = alpha_hooks"),
        ("locator", "toy-locator", "alpha", "1.2", "alpha = alpha_hooks"),
    ]
    assert catalog.find("source", "toy-camera").contribution.summary == "A toy"
    assert of_toys(catalog.broken) == []


@pytest.mark.parametrize(("code", "error"), BROKEN, ids=[code.splitlines()[-1].strip() for code, _ in BROKEN])
def test_broken_plugin_is_a_row_and_harms_no_other(code, error, install, tmp_path):
    install("alpha", "1.2", GOOD)
    install("broken", "0.3", code)
    catalog = discover()
    error = error.replace("{path}", str(tmp_path / "broken_hooks.py"))
    assert of_toys(catalog.broken) == [BrokenPlugin(Origin("broken", "0.3", "broken = broken_hooks"), error)]
    assert {row.origin.plugin for row in of_toys(catalog.rows)} == {"alpha"}


def test_name_of_two_plugins_is_an_error_on_use_until_one_is_disabled(install, monkeypatch):
    install("alpha", "1.2", GOOD)
    install("beta", "2.0", GOOD)
    catalog = discover()
    assert len(of_toys(catalog.rows)) == 6
    with pytest.raises(PluginError) as caught:
        catalog.find("source", "toy-camera")
    assert str(caught.value) == (
        "the source 'toy-camera' is offered by alpha 1.2 (alpha = alpha_hooks) and beta 2.0 (beta = beta_hooks); "
        "uninstall or disable all but one"
    )
    monkeypatch.setenv("PHOTONPANO_DISABLE_PLUGINS", "alpha")
    assert discover().find("source", "toy-camera").origin.plugin == "beta"


def test_observers_are_kept_apart_from_components(install):
    install("watcher", "0.4", "@hookimpl\ndef photonpano_run_started(spec): pass")
    install("both", "0.5", GOOD + "@hookimpl\ndef photonpano_run_finished(): pass")
    catalog = discover()
    assert [(str(each.origin), each.watches) for each in catalog.observers] == [
        ("both 0.5 (both = both_hooks)", ("photonpano_run_finished",)),
        ("watcher 0.4 (watcher = watcher_hooks)", ("photonpano_run_started",)),
    ]
    assert {row.origin.plugin for row in of_toys(catalog.rows)} == {"both"}


@pytest.mark.parametrize("word", ["Beta", "beta_lab", "beta-lab", " beta.lab ,"])
def test_disabled_plugin_is_a_row_and_is_not_imported(word, install, monkeypatch):
    install("alpha", "1.2", GOOD)
    install("beta", "2.0", "raise SystemExit('imported')", distribution="beta-lab")
    monkeypatch.setenv("PHOTONPANO_DISABLE_PLUGINS", word)
    catalog = discover()
    by = f"PHOTONPANO_DISABLE_PLUGINS={word.strip(' ,')}"
    assert of_toys(catalog.disabled) == [DisabledPlugin(Origin("beta-lab", "2.0", "beta = beta_hooks"), by)]
    assert of_toys(catalog.broken) == []
    assert {row.origin.plugin for row in of_toys(catalog.rows)} == {"alpha"}


@pytest.mark.parametrize(
    ("words", "message", "disabled"),
    [
        ("alpa", "names 'alpa', which is no installed plugin; did you mean 'alpha'?", 0),
        ("zzz,alpha, yyy", "names 'zzz' and 'yyy', which are no installed plugins; known: {known}", 1),
        ("", "", 0),
        (" , ", "", 0),
        ("alpha", "", 1),
    ],
)
def test_disabling_unknown_plugin_is_logged(words, message, disabled, install, monkeypatch, caplog):
    install("alpha", "1.2", GOOD)
    monkeypatch.setenv("PHOTONPANO_DISABLE_PLUGINS", words)
    assert len(of_toys(discover().disabled)) == disabled
    known = "alpha, colmap, core, dask, direct, framework, kornia, opencv, photonpano, poses, sensors, simulator and zarr"
    assert caplog.messages == ([f"PHOTONPANO_DISABLE_PLUGINS {message.format(known=known)}"] if message else [])
