from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import Group, Located, NotLocated, PluginError
from photonpano.geometry import translation
from photonpano.motion.registration import BRIDGE
from photonpano.specs.settings import GraphSettings

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_fallback_gets_pairs_that_the_locator_does_not_locate_and_no_others(
    run: Callable, make_level: Callable, pan: Callable, threads: int, failing: Callable, make_second: type
) -> None:
    motion = pan(0.3)
    second, third = make_second(motion), make_second(motion)
    level = make_level(motion, failing(4, 5), fallbacks={"second": second, "third": third})
    found = run(level, graph=GraphSettings(skips=(1.0, 2.0)), threads=threads)
    assert found.n_located == 12
    np.testing.assert_allclose(found.homographies[:, 0, 2], 0.3 * (found.instants - found.instants[6]), atol=1e-9)
    by_second = {(edge.moving, edge.fixed) for edge in found.edges if edge.locator == "second"}
    assert by_second == {(4, 3), (4, 2), (5, 4), (5, 3), (6, 5), (6, 4), (7, 5)}
    assert {edge.locator for edge in found.edges} == {"toy", "second"}
    assert sorted(second.shown) == [2, 3, 4, 5, 6, 7]
    assert third.shown == []


def test_fallback_gets_pairs_with_an_implausible_motion(
    run: Callable, make_level: Callable, pan: Callable, make_second: type
) -> None:
    def mirror(moving: Group, fixed: Group, found: Located) -> Located:
        mirrored = translation(59, 0) @ np.diag([-1.0, 1.0, 1.0])
        return Located(mirrored) if 40 in (moving.span.start, fixed.span.start) else found

    found = run(make_level(pan(0.3), mirror, fallbacks={"second": make_second(pan(0.3))}))
    assert [(edge.moving, edge.fixed) for edge in found.edges if edge.locator == "second"] == [(4, 3), (5, 4)]
    assert found.failures == ()


def test_failure_of_all_locators_joins_their_reasons(
    run: Callable, make_level: Callable, pan: Callable, make_second: type
) -> None:
    def lost(reason: str, **evidence: float) -> Callable[..., Any]:
        def answer(moving: Group, fixed: Group, found: Located) -> Located | NotLocated:
            return NotLocated(reason, evidence) if 40 in (moving.span.start, fixed.span.start) else found

        return answer

    second = make_second(pan(0.3), lost("2 matches", matches=2))
    found = run(make_level(pan(0.3), lost("the overlap is 3 %", overlap=0.03), fallbacks={"second": second}))
    (failure, *_) = found.failures
    assert failure.locator == ""
    assert failure.motion.reason == "toy: the overlap is 3 %; second: 2 matches"
    assert failure.motion.evidence == {"toy.overlap": 0.03, "second.matches": 2}
    assert [(edge.moving, edge.fixed) for edge in found.failures] == [(4, 3), (4, 2), (4, 1), (5, 4)]


def test_fallback_is_not_believed_where_it_contradicts_pairs_of_the_locator_in_between(
    run: Callable, make_level: Callable, pan: Callable, make_second: type
) -> None:
    """Distant exposures share an object rather than the scene: the first locator fails, and the second follows the object."""

    def near(moving: Group, fixed: Group, found: Located) -> Located | NotLocated:
        return found if moving.span.start - fixed.span.start == 10 else NotLocated("lost")

    second = make_second(pan(-0.5))
    found = run(make_level(pan(0.3), near, fallbacks={"second": second}), graph=GraphSettings(skips=(1.0, 4.0)))
    np.testing.assert_allclose(found.homographies[:, 0, 2], 0.3 * (found.instants - found.instants[6]), atol=1e-9)
    reasons = {edge.moving - edge.fixed: edge.motion.reason for edge in found.failures}
    assert reasons[4] == "second: the motion is 32 px from that along the pairs of toy in between"
    assert 1 not in reasons


def test_fallback_is_believed_where_the_locator_does_not_tie_the_exposures(
    run: Callable, make_level: Callable, pan: Callable, failing: Callable, make_second: type
) -> None:
    def behind(moving: Group, fixed: Group, found: Located) -> Located | NotLocated:
        return NotLocated("lost") if moving.span.start >= 60 > fixed.span.start else found

    jump = make_second(pan(0.3), lambda _, __, found: Located(translation(50, 0) @ found.homography))
    found = run(make_level(pan(0.3), behind, fallbacks={"second": jump}), graph=GraphSettings(skips=(1.0, 2.0)))
    np.testing.assert_allclose(found.homographies[6:, 0, 2] - found.homographies[5, 0, 2], 50 + 3 * np.arange(1, 7), atol=1e-6)


def test_fallback_does_not_describe_blank_exposures(
    run: Callable, make_level: Callable, pan: Callable, failing: Callable, make_second: type
) -> None:
    second = make_second(pan(0.3))
    level = make_level(pan(0.3), failing(4), fallbacks={"second": second})
    merge = level.merger.merge

    class Shuttered:
        def merge(self, source: Any, group: Group, trajectory: Any, scale: float) -> Any:
            exposure = merge(source, group, trajectory, scale)
            return replace(exposure, flux=np.zeros_like(exposure.flux)) if group.span.start == 40 else exposure

    found = run(replace(level, merger=Shuttered()))
    assert second.shown == []
    assert {edge.locator for edge in found.failures} == {""}


def test_fallback_features_are_released_as_early_as_the_locators(
    run: Callable, make_level: Callable, pan: Callable, failing: Callable, make_second: type
) -> None:
    alive: weakref.WeakSet[Any] = weakref.WeakSet()
    most = 0

    class Features:
        def __init__(self, group: Group) -> None:
            self.group = group

    class Watched(make_second):
        def describe(self, exposure: Any) -> Features:
            nonlocal most
            features = Features(exposure.group)
            alive.add(features)
            gc.collect()
            most = max(most, len(alive))
            return features

    found = run(make_level(pan(0.3), failing(*range(12)), fallbacks={"second": Watched(pan(0.3))}), threads=1)
    assert [edge.locator for edge in found.edges] == ["second"] * 11
    assert most <= BRIDGE + 2


@pytest.mark.parametrize("method", ["describe", "register"])
def test_fallback_that_raises_is_named(
    run: Callable, make_level: Callable, pan: Callable, method: str, failing: Callable, make_second: type
) -> None:
    def fail(*_: Any) -> Any:
        raise ZeroDivisionError("oops")

    second = make_second(pan(0.3))
    setattr(second, method, fail)
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3), failing(4), fallbacks={"second": second}))
    assert str(caught.value) == "locator 'second' of toys 1.0 failed at level 1: ZeroDivisionError: oops"


def test_fallback_that_breaks_its_contract_is_named(
    run: Callable, make_level: Callable, pan: Callable, failing: Callable, make_second: type
) -> None:
    second = make_second(pan(0.3), lambda *_: None)
    with pytest.raises(PluginError) as caught:
        run(make_level(pan(0.3), failing(4), fallbacks={"second": second}))
    problem = "expected Located or NotLocated, got NoneType"
    assert str(caught.value) == f"locator 'second' of toys 1.0 broke its contract at level 1: {problem}"
