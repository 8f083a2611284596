"""Which exposures are registered: neighbours, and places that are seen again."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import FrameSpan, Group, VirtualExposure
from photonpano.geometry import inverse, rescaling, translation
from photonpano.motion.graph import GraphSolution
from photonpano.motion.pairs import pairs_of, shared_share
from photonpano.motion.registration import closure_candidates, exposure_similarity
from photonpano.specs.settings import GraphSettings
from photonpano.testing import photographed
from photonpano.testing.captures import seen_along


def groups(*starts: int, size: int = 100) -> list[Group]:
    return [Group(FrameSpan(start, start + size), start + (size - 1) / 2) for start in starts]


@pytest.mark.parametrize(
    ("starts", "skips", "moving", "pairs"),
    [
        ((0, 100, 200, 300), (), None, [(1, 0), (2, 1), (3, 2)]),
        ((0, 100, 200, 300), (1.0, 2.0), None, [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2)]),
        # As at the second level: two before, the next one beyond, and four before; not the neighbour.
        ((0, 50, 100, 150, 200, 250), (1.0, 2.0), 5, [(5, 1), (5, 2), (5, 3)]),
        ((0, 50, 100, 150, 200, 250), (1.0, 2.0), 2, [(2, 0)]),
        ((0, 30, 60), (1.0,), None, [(1, 0), (2, 1)]),
        ((0, 45, 90, 135, 180), (1.0,), 4, [(4, 1), (4, 2)]),
    ],
    ids=["chain", "adjacent", "half a group apart", "the first that shares no frame", "else disconnected", "nearest instant"],
)
def test_pairs_of_groups_of_one_length(
    starts: tuple[int, ...], skips: tuple[float, ...], moving: int | None, pairs: list[tuple[int, int]]
) -> None:
    assert [pair for pair in pairs_of(groups(*starts), skips) if moving in (None, pair[0])] == pairs


@given(
    gaps=st.lists(st.integers(1, 200), min_size=1, max_size=30),
    skips=st.lists(st.floats(0.1, 10), max_size=3),
)
def test_pairs_are_ordered_and_connect_all_exposures(gaps: list[int], skips: list[float]) -> None:
    spread = groups(*(int(start) for start in np.cumsum(gaps)))
    pairs = pairs_of(spread, skips)
    assert pairs == sorted(set(pairs))
    assert all(0 <= fixed < moving < len(spread) for moving, fixed in pairs)
    assert {edge for pair in pairs for edge in pair} == set(range(len(spread))) or len(spread) == 1
    reached = {0}
    for _ in spread:
        reached |= {index for pair in pairs for index in pair if reached & set(pair)}
    assert reached == set(range(len(spread)))
    assert len(pairs) <= (len(spread) - 1) + 2 * (len(skips) + 1) * len(spread)


@pytest.mark.parametrize(
    ("first", "second", "share"),
    [
        ((0, 100), (100, 200), 0),
        ((0, 100), (50, 150), 0.5),
        ((0, 100), (0, 100), 1),
        ((0, 100), (20, 40), 1),
        ((0, 9), (20, 29), 0),
    ],
)
def test_shared_share_is_relative_to_the_shorter_span(first: tuple[int, int], second: tuple[int, int], share: float) -> None:
    assert shared_share(FrameSpan(*first), FrameSpan(*second)) == share
    assert shared_share(FrameSpan(*second), FrameSpan(*first)) == share


SHAPE = (128, 160)
HERE, NEARBY, ELSEWHERE = translation(20, 20), translation(40.3, 27.6), translation(230, 90)


@cache
def scene(seed: int) -> np.ndarray:
    """A plane of 240x420 px with structures of all sizes from 3 px on, bright and dark by half a stop about 1."""
    noise = np.random.default_rng(seed).normal(size=(240, 420))
    structure = cv2.GaussianBlur(noise, (0, 0), 3) + 4 * cv2.GaussianBlur(noise, (0, 0), 12)
    return np.exp(0.5 * structure / structure.std())


def seen(
    plane: np.ndarray, to_plane: np.ndarray, flux: float, rng: np.random.Generator, scale: float = 1.0, **options: Any
) -> VirtualExposure:
    """Expose a camera that stands still, with the noise of its photons."""
    shape = tuple(round(side * scale) for side in SHAPE)
    mean = seen_along(plane, to_plane @ inverse(rescaling(scale)), shape)[0] * flux
    return replace(photographed(mean, seed=rng, **{"n_frames": 250} | options), scale=scale)


def several(measure: Callable[[np.ndarray, np.random.Generator], float], times: int = 12) -> np.ndarray:
    return np.array([measure(scene(seed), np.random.default_rng(seed)) for seed in range(times)])


def similarities(flux: float, there: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Compare what is seen here with what is seen from another place, as if it were nearby."""

    def similarity(plane: np.ndarray, rng: np.random.Generator) -> float:
        moving, fixed = (seen(plane, place, flux, rng, scale) for place in (HERE, there))
        return exposure_similarity(moving, fixed, inverse(NEARBY) @ HERE)

    return several(similarity)


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("flux", [1.0, 0.1, 0.02])
def test_exposure_similarity_is_1_for_one_place_at_any_noise(flux: float, scale: float) -> None:
    """At flux 0.02, most of what varies between pixels is noise: a plain correlation would be below 0.9."""
    found = similarities(flux, NEARBY, scale)
    assert found.mean() == pytest.approx(1, abs=0.005)
    assert 0.97 < found.min() < found.max() < 1.03


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("flux", [1.0, 0.1, 0.02, 0.002])
def test_exposure_similarity_is_small_for_different_places(flux: float, scale: float) -> None:
    assert np.abs(similarities(flux, ELSEWHERE, scale)).max() < 0.6


ROLL = np.array([[np.cos(0.35), -np.sin(0.35), 90], [np.sin(0.35), np.cos(0.35), 30], [2e-4, 0, 1]])
COLUMNS, ROWS = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
COLUMNS[:, 70:90] = COLUMNS[5, 5] = ROWS[20:40] = True


@pytest.mark.parametrize(
    ("places", "moving", "fixed"),
    [
        ((ROLL, translation(80, 60)), {}, {}),
        ((HERE, NEARBY), {"n_frames": 60}, {"n_frames": 1000}),
        ((NEARBY, HERE), {"n_frames": 1000}, {"n_frames": 60}),
        ((HERE, NEARBY), {"unseen": COLUMNS}, {"unseen": ROWS}),
    ],
    ids=["roll and tilt", "short onto long", "long onto short", "unseen pixels"],
)
def test_exposure_similarity_is_1_for_one_place(
    places: tuple[np.ndarray, np.ndarray], moving: dict[str, Any], fixed: dict[str, Any]
) -> None:
    rng = np.random.default_rng(0)
    here, there = places
    first, second = (seen(scene(0), place, 0.1, rng, **more) for place, more in ((here, moving), (there, fixed)))
    assert exposure_similarity(first, second, inverse(there) @ here) == pytest.approx(1, abs=0.02)


FIELD = (40, 60)  # height and width of the frames whose overlap is counted


def candidates(
    spread: list[Group],
    homographies: np.ndarray,
    located: np.ndarray,
    skips: tuple[float, ...] = (1.0, 2.0),
    min_overlap: float | None = 0.5,
) -> list[tuple[int, int]]:
    solution = GraphSolution(
        homographies=homographies,
        located=located,
        outliers=(),
        residual_px=0.0,
        assess=lambda: (np.empty((0, 8, 8)), np.empty(0)),
    )
    graph = GraphSettings(skips=skips, closure_overlap=min_overlap)
    return closure_candidates(spread, solution, FIELD, graph)


def visiting(
    places: np.ndarray, *, step: int = 100, skips: tuple[float, ...] = (1.0, 2.0), min_overlap: float = 0.5
) -> list[tuple[int, int]]:
    """Visit (x, y) places with exposures of 100 frames, `step` frames apart."""
    homographies = np.array([translation(x, y) for x, y in places])
    spread = groups(*range(0, step * len(places), step))
    return candidates(spread, homographies, np.ones(len(places), bool), skips, min_overlap)


def line(*x_px: float) -> np.ndarray:
    return np.array([(x, 0.0) for x in x_px])


FORTH = np.arange(20) * 9.0
BACK = FORTH[::-1]
THERE_AND_BACK = line(*FORTH, *BACK)


def raster(rows_px: float, n_rows: int = 3) -> np.ndarray:
    """Sweep over rows at a distance of `rows_px`, forth and back."""
    x = np.concatenate([FORTH if row % 2 == 0 else BACK for row in range(n_rows)])
    return np.stack([x, np.repeat(np.arange(n_rows) * rows_px, len(FORTH))], axis=1)


def test_candidates_on_the_way_back_pair_exposures_of_one_place() -> None:
    """Exposure 20 + i shows the place of 19 - i; those around the turn are registered as neighbours."""
    assert visiting(THERE_AND_BACK) == [(20 + i, 19 - i) for i in range(2, 20)]


def test_candidates_of_a_raster_include_all_earlier_rows_that_overlap() -> None:
    """Rows 8 px apart in a field of 40 px: the third row sees both others, apart from where they turn."""
    pairs = visiting(raster(8))
    assert {(40 + i, 39 - i) for i in range(3, 20)} <= set(pairs)
    assert {(40 + i, i) for i in range(17)} <= set(pairs)
    assert {(20 + i, 19 - i) for i in range(3, 20)} <= set(pairs)
    # Rows 24 px apart share less than half of the field of view.
    assert visiting(raster(24)) == []
    assert visiting(raster(24), min_overlap=0.3) != []


def test_candidates_overlap_by_the_least_share() -> None:
    """On the way back the first place is missed by 20 of 60 px."""
    places = line(0, 60, 120, 180, 240, 180, 120, 60, 20)
    assert visiting(places, min_overlap=0.6) == [(6, 2), (7, 1), (8, 0)]
    assert visiting(places, min_overlap=0.7) == [(6, 2), (7, 1)]


def tremor(std_px: float, seed: int, n: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=std_px, size=(n, 2))


@pytest.mark.parametrize(
    "places",
    [
        line(*(np.arange(60) * 9.0)),
        line(*(np.arange(60) * 0.5)),
        line(*(np.arange(60) * 3.0)) + tremor(1.0, 0),
        line(0.0),
        line(0.0, 0.0),
        *(tremor(std_px, seed) for std_px in (0, 1e-6, 0.01, 1.0) for seed in range(5)),
    ],
)
def test_candidates_are_none_for_a_pan_or_a_trembling_camera(places: np.ndarray) -> None:
    assert visiting(places) == []


@given(
    places=st.lists(st.tuples(st.floats(-80, 80), st.floats(-40, 40)), min_size=1, max_size=40),
    step=st.integers(20, 150),
    skips=st.lists(st.floats(0.1, 4), max_size=3),
    min_overlap=st.floats(0.05, 0.95),
)
def test_candidates_are_ordered_unique_and_beyond_the_skips(
    places: list[tuple[float, float]], step: int, skips: list[float], min_overlap: float
) -> None:
    pairs = visiting(np.array(places), step=step, skips=tuple(skips), min_overlap=min_overlap)
    assert pairs == sorted(set(pairs))
    assert all(step * (moving - fixed) >= 200 * max([1.0, *skips]) for moving, fixed in pairs)
    assert max(np.bincount([moving for moving, _ in pairs]), default=0) <= 3
    for moving, fixed in pairs:
        away = np.abs(np.subtract(places[moving], places[fixed]))
        # Counted on a grid of eight by eight.
        assert np.prod(np.maximum(0, 1 - away / [59, 39]) + 1 / 8) >= min_overlap
