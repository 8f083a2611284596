"""Specs with the most extreme values that their keys allow: a plan, or problems."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import SpecError
from photonpano.registry import KINDS, Catalog, discover
from photonpano.registry.description import config_schema
from photonpano.specs import parse_spec
from photonpano.specs.settings import GraphSettings, RenderSettings, RunSettings

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


def specs(catalog: Catalog) -> Iterator[dict[str, Any]]:
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
    for sections in islice(specs(installed), 0, None, 4):
        tried += 1
        try:
            parse_spec(spec | sections, catalog=installed)
        except SpecError:
            refused += 1
    assert (tried > 100, refused > 25) == (True, True), (tried, refused)
