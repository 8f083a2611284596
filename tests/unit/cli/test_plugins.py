"""The commands `plugins list` and `plugins show`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from pydantic import Field

from photonpano import Config, LocatorContribution, Requirement, hookimpl
from photonpano.registry import BrokenPlugin, Catalog, DisabledPlugin, Observer, Origin
from photonpano.registry.catalog import make_entry
from photonpano.registry.plugins import observation_of
from photonpano.specs import parse_spec


class Keys(Config):
    ratio: float = Field(0.8, gt=0, description="how far")


def locator(name: str, *requires: Requirement) -> LocatorContribution:
    return LocatorContribution(name=name, summary="A toy", config=Keys, build=lambda *_: None, requires=requires)


@pytest.fixture
def odd_catalog(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [make_entry(locator("twice"), Origin(plugin, "2.0", f"{plugin} = {plugin}.hooks")) for plugin in ("alpha", "beta")]
    rows.append(
        make_entry(locator("far", Requirement("no_such_library", "gamma[far]")), Origin("gamma", "1.0", "g = gamma.hooks"))
    )
    broken = BrokenPlugin(Origin("delta", "0.3", "d = delta.hooks"), "ImportError: no module named [delta]")
    disabled = DisabledPlugin(Origin("epsilon", "0.4", "e = epsilon.hooks"), "PHOTONPANO_DISABLE_PLUGINS=e")
    plugin = ModuleType("zeta")
    plugin.photonpano_run_started = plugin.photonpano_run_finished = hookimpl(lambda: None)
    observer = Observer(Origin("zeta", "0.5", "z = zeta.hooks"), observation_of(plugin))
    catalog = Catalog(tuple(rows), (broken,), (disabled,), (observer,))
    monkeypatch.setattr("photonpano.registry.discover", lambda: catalog)


def test_plugins_list_of_kind_prints_sorted_names(invoke: Callable[..., Any]) -> None:
    result = invoke("plugins", "list", "--kind", "source")
    assert (result.exit_code, result.stderr) == (0, "")
    head, *rows = result.stdout.splitlines()
    assert head.split() == ["KIND", "NAME", "PLUGIN", "SUMMARY"]
    names = [row.split()[1] for row in rows if row.split()[0::2][:2] == ["source", "photonpano"]]
    assert len(names) == len(rows)
    assert names == sorted(names)
    assert {"auto", "packed-npy", "simulator", "swissspad-half"} <= set(names)


@pytest.mark.usefixtures("odd_catalog")
def test_plugins_list_marks_unusable_components(invoke: Callable[..., Any]) -> None:
    result = invoke("plugins", "list")
    assert result.stdout == (
        "KIND      NAME   PLUGIN       SUMMARY\n"
        "locator   twice  alpha 2.0    [name taken twice] A toy\n"
        "locator   twice  beta 2.0     [name taken twice] A toy\n"
        "locator   far    gamma 1.0    [not installed: gamma[far]] A toy\n"
        "observer  z      zeta 0.5     Watches runs: photonpano_run_started, photonpano_run_finished\n"
        "disabled  e      epsilon 0.4  By PHOTONPANO_DISABLE_PLUGINS=e\n"
    )
    assert result.stderr == "1 plugin is broken, see: photonpano plugins list --broken\n"


@pytest.mark.usefixtures("odd_catalog")
def test_plugins_list_broken_prints_errors(invoke: Callable[..., Any]) -> None:
    result = invoke("plugins", "list", "--broken")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == "delta 0.3 (d = delta.hooks): ImportError: no module named [delta]\n"


@pytest.mark.usefixtures("odd_catalog")
def test_plugins_list_json_holds_all_states(invoke: Callable[..., Any]) -> None:
    data = json.loads(invoke("plugins", "list", "--kind", "locator", "--json").stdout)
    assert [(row["name"], row["plugin"]) for row in data["components"]] == [
        ("twice", "alpha"),
        ("twice", "beta"),
        ("far", "gamma"),
    ]
    assert data["components"][2]["unavailable"] == (
        "the locator 'far' needs no_such_library, which is not installed: pip install \"gamma[far]\""
    )
    assert data["broken"] == [
        {
            "plugin": "delta",
            "version": "0.3",
            "entry_point": "d = delta.hooks",
            "error": "ImportError: no module named [delta]",
        }
    ]
    assert data["disabled"] == [
        {"plugin": "epsilon", "version": "0.4", "entry_point": "e = epsilon.hooks", "by": "PHOTONPANO_DISABLE_PLUGINS=e"}
    ]
    assert data["observers"] == [
        {
            "plugin": "zeta",
            "version": "0.5",
            "entry_point": "z = zeta.hooks",
            "hooks": ["photonpano_run_started", "photonpano_run_finished"],
        }
    ]


@pytest.mark.usefixtures("odd_catalog")
def test_plugins_list_of_kind_includes_disabled_plugins(invoke: Callable[..., Any]) -> None:
    assert invoke("plugins", "list", "--kind", "source").stdout == (
        "KIND      NAME  PLUGIN       SUMMARY\ndisabled  e     epsilon 0.4  By PHOTONPANO_DISABLE_PLUGINS=e\n"
    )


def test_plugins_list_broken_prints_a_line_when_none_is(invoke: Callable[..., Any]) -> None:
    assert invoke("plugins", "list", "--broken").stdout == "no plugin is broken\n"


def test_plugins_show_prints_keys_and_valid_snippet(finished: Path, invoke: Callable[..., Any]) -> None:
    text = invoke("plugins", "show", "packed-npy").stdout
    head, facts, table, snippet = text.split("\n\n")
    assert head.startswith("packed-npy: ")
    assert facts == "kind    source\nplugin  photonpano 0.1.0 (core = photonpano_core.hooks)"
    assert [line.split()[0] for line in table.splitlines()] == [
        "KEY",
        "path",
        "frame_rate_hz",
        "width",
        "channel",
        "bit_order",
        "packed_along",
        "height",
        "frames",
    ]
    assert "required" in table
    plan = parse_spec("version: 1\n" + snippet.replace('"<path>"', "cube.npy"), directory=finished)
    assert plan.source.contribution.name == "packed-npy"


@pytest.mark.usefixtures("odd_catalog")
def test_plugins_show_prints_install_line_for_missing_library(invoke: Callable[..., Any]) -> None:
    assert invoke("plugins", "show", "far").stdout == (
        "far: A toy\n\n"
        "kind    locator\n"
        "plugin  gamma 1.0 (g = gamma.hooks)\n"
        'needs   no_such_library (not installed): pip install "gamma[far]"\n\n'
        "KEY    TYPE    DEFAULT  BOUNDS   MEANING\n"
        "ratio  number  0.8      above 0  how far\n\n"
        "locate:\n  use: far\n  with:\n    ratio: 0.8  # how far\n"
    )


@pytest.mark.usefixtures("odd_catalog")
def test_plugins_show_refuses_name_offered_twice(invoke: Callable[..., Any]) -> None:
    result = invoke("plugins", "show", "twice")
    assert result.exit_code == 1
    assert result.stderr == (
        "error: the locator 'twice' is offered by alpha 2.0 (alpha = alpha.hooks) and beta 2.0 (beta = beta.hooks); "
        "uninstall or disable all but one\n"
    )


@pytest.mark.usefixtures("odd_catalog")
def test_plugins_show_lists_broken_and_disabled_plugins_for_unknown_name(invoke: Callable[..., Any]) -> None:
    result = invoke("plugins", "show", "near")
    assert result.exit_code == 2
    assert result.stderr.endswith(
        "there is no component 'near'; known: far and twice. Broken plugins may have offered it: delta 0.3 (d = delta.hooks): "
        "ImportError: no module named [delta]. Disabled plugins may have offered it: epsilon 0.4 (e = epsilon.hooks), "
        "by PHOTONPANO_DISABLE_PLUGINS=e\n"
    )


@pytest.mark.usefixtures("odd_catalog")
def test_plugins_show_json_holds_all_fields(invoke: Callable[..., Any]) -> None:
    (shown,) = json.loads(invoke("plugins", "show", "far", "--json").stdout)["components"]
    assert shown == {
        "kind": "locator",
        "name": "far",
        "summary": "A toy",
        "plugin": "gamma",
        "version": "1.0",
        "entry_point": "g = gamma.hooks",
        "unavailable": "the locator 'far' needs no_such_library, which is not installed: pip install \"gamma[far]\"",
        "api_version": 1,
        "requires": [{"module": "no_such_library", "install": "gamma[far]"}],
        "keys": [{"key": "ratio", "type": "number", "default": "0.8", "bounds": "above 0", "description": "how far"}],
        "snippet": "locate:\n  use: far\n  with:\n    ratio: 0.8  # how far\n",
    }


def test_plugins_show_suggests_names_for_unknown_name(invoke: Callable[..., Any]) -> None:
    result = invoke("plugins", "show", "opencv-shift")
    assert result.exit_code == 2
    assert "Invalid value for 'NAME': there is no component 'opencv-shift'; did you mean 'opencv-sift'" in result.stderr
    wrong_kind = invoke("plugins", "show", "opencv-sift", "--kind", "source")
    assert "there is no source 'opencv-sift'; it is one of the locators" in wrong_kind.stderr
