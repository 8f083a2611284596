"""Exposures that are tied by hand, or left out of registration."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from photonpano import Group, LocationError
from photonpano.motion.pairs import TIE
from photonpano.specs.settings import GraphSettings


def test_a_tie_connects_parts_that_no_pair_connects(
    run: Callable, make_level: Callable, failing: Callable, tmp_path: Path
) -> None:
    """The camera moves by 0.3 px a frame, and exposures 5 to 8 show nothing; without the tie, this is an error."""
    (file := tmp_path / "ties.csv").write_text("frame_a,x_a,y_a,frame_b,x_b,y_b\n45,40,20,95,25,20\n")
    with pytest.raises(LocationError, match="cannot be tied to the rest"):
        run(make_level(answer=failing(5, 6, 7, 8)))
    graph = GraphSettings.model_validate({"skips": (), "tie": file, "disconnected": "largest"})
    found = run(make_level(answer=failing(5, 6, 7, 8)), graph=graph)
    assert found.solution.located.tolist() == [True] * 5 + [False] * 4 + [True] * 3
    assert [(edge.moving, edge.fixed, edge.locator) for edge in found.edges if edge.locator == TIE] == [(9, 4, TIE)]
    shifts = found.homographies[:, 0, 2]
    np.testing.assert_allclose(shifts - shifts[0], 3.0 * np.array([0, 1, 2, 3, 4, 9, 10, 11]), atol=0.02)


def test_excluded_pairs_are_not_registered_nor_bridged(run: Callable, make_level: Callable) -> None:
    asked = set()

    def answer(moving: Group, fixed: Group, found: object) -> object:
        asked.add((moving.span.start // 10, fixed.span.start // 10))
        return found

    run(make_level(answer=answer), graph=GraphSettings(skips=(1.0, 2.0), exclude=((51, 32), (60, 50))))
    assert not asked & {(5, 3), (6, 5)}
    assert {(5, 4), (6, 4), (7, 5)} <= asked
