"""A locator loses some pairs, and its fallback locates them."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import Field

from photonpano import Config, Located, LocatorContribution, NotLocated, StageContext, VirtualExposure
from photonpano.plugins.registry import Catalog, Origin, discover, make_entry
from photonpano.specs import parse_spec
from photonpano.values import Homography

pytestmark = pytest.mark.usefixtures("without_report")

SIFT = discover().find("locator", "opencv-sift").contribution


class ForgetfulConfig(Config):
    every: int = Field(ge=1, description="one in so many groups is lost")
    group_size: int = Field(50, ge=1, description="frames of a group")


class Forgetful:
    """SIFT that loses the pairs of some groups."""

    def __init__(self, config: ForgetfulConfig, context: StageContext) -> None:
        self._config = config
        self._sift = SIFT.build(SIFT.config(), context)

    def describe(self, exposure: VirtualExposure) -> Any:
        number = exposure.group.span.start // self._config.group_size
        return number, self._sift.describe(exposure)

    def register(self, moving: Any, fixed: Any, initial: Homography | None) -> Located | NotLocated:
        if not (moving[0] % self._config.every and fixed[0] % self._config.every):
            return NotLocated("it slipped my mind", {"every": self._config.every})
        return self._sift.register(moving[1], fixed[1], initial)


FORGETFUL = LocatorContribution(name="forgetful", summary="Loses pairs", config=ForgetfulConfig, build=Forgetful)


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return Catalog((*discover().rows, make_entry(FORGETFUL, Origin("toys", "1.2", "toys = toys.hooks"))))


@pytest.fixture(scope="module")
def run(outcome_of: Callable) -> Callable[..., Any]:
    def run(spec: dict[str, Any], catalog: Catalog, threads: int = 2) -> Any:
        return outcome_of(parse_spec(spec | {"levels": 1, "refine": [], "run": {"threads": threads}}, catalog=catalog))

    return run


FORGETS = {"use": "forgetful", "with": {"every": 3}}


@pytest.fixture(scope="module")
def rescued(run: Callable, small_spec: dict[str, Any], catalog: Catalog) -> Any:
    return run(small_spec | {"locate": FORGETS | {"fallback": "opencv-sift"}}, catalog, threads=3)


def test_run_with_failing_locator_matches_its_fallback(
    run: Callable, rescued: Any, small_spec: dict[str, Any], catalog: Catalog
) -> None:
    sift = run(small_spec | {"locate": {"use": "opencv-sift"}}, catalog)
    np.testing.assert_array_equal(rescued.homographies, sift.homographies)
    (level,) = rescued.record["levels"]
    # Of the pairs of six groups, 1-0, 2-1, ..., 2-0, 3-1, ..., 4-0 and 5-1, all with group 0 or 3.
    assert level["located_by"] == {"forgetful": 4, "opencv-sift": 7}
    by_sift = [(each["moving"][0] // 50, each["fixed"][0] // 50, each["by"]) for each in level["rescued"]]
    assert sorted(by_sift) == [
        (moving, fixed, "opencv-sift") for moving, fixed in [(1, 0), (2, 0), (3, 1), (3, 2), (4, 0), (4, 3), (5, 3)]
    ]
    assert (level["pairs"], level["located"], level["failures"]) == (11, 6, [])
    assert sift.record["levels"][0]["located_by"] == {"opencv-sift": 11}
    assert sift.record["levels"][0]["rescued"] == []
    located = [each for each in rescued.record["plugins"] if each["stage"] == "locate"]
    assert [(each["use"], each["plugin"], each["version"]) for each in located] == [
        ("forgetful", "toys", "1.2"),
        ("opencv-sift", "photonpano", discover().find("locator", "opencv-sift").origin.version),
    ]
    recorded = parse_spec(json.loads(json.dumps(rescued.record["spec"])), catalog=catalog)
    assert [each.contribution.name for each in recorded.levels[0].fallbacks] == ["opencv-sift"]
