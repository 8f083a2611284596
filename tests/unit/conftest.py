"""A level whose components know the true motion, to test the loop without plugins."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, NotLocated, Source, Trajectory, VirtualExposure
from photonpano.contracts.attribution import attributed
from photonpano.execution.threads import one_thread_inside
from photonpano.geometry import inverse, normalised, rescaled, translation
from photonpano.motion.level import Level, NamedLocator
from photonpano.photometry import BinaryResponse
from photonpano.testing import KnownMotion

FRAMES = 10  # of a group
STEADY = KnownMotion(lambda frame: translation(0.3 * frame, 0))


class SideBySide:
    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        step = FRAMES // level
        starts = range(0, n_frames - FRAMES + 1, step)
        return tuple(Group(FrameSpan(start, start + FRAMES), start + (FRAMES - 1) / 2) for start in starts)


class Noise:
    """Returns a noisy exposure for each group, without reading frames."""

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        shape = tuple(max(1, round(side * scale)) for side in source.info.frame_shape)
        flux = np.random.default_rng(group.span.start).random(shape, np.float32)
        return VirtualExposure(flux, np.full(shape, FRAMES, np.float32), group, scale, BinaryResponse())


class Knowing:
    """Returns the true motion of a pair, in px of exposures, or what `answer` makes of it."""

    def __init__(self, motion: Trajectory, answer: Callable[..., Any]) -> None:
        self._motion = motion
        self._answer = answer
        self.initials: list[np.ndarray | None] = []

    def describe(self, exposure: VirtualExposure) -> VirtualExposure:
        return exposure

    def register(self, moving: VirtualExposure, fixed: VirtualExposure, initial: np.ndarray | None) -> Located | NotLocated:
        self.initials.append(initial)
        to_plane = self._motion.at([moving.group.reference, fixed.group.reference])
        found = Located(rescaled(normalised(inverse(to_plane[1]) @ to_plane[0]), moving.scale))
        return self._answer(moving.group, fixed.group, found)


class Knots:
    """Linear between the knots, element by element, and beyond them."""

    def __init__(self, instants: np.ndarray, homographies: np.ndarray) -> None:
        self._instants, self._knots = instants, homographies

    def at(self, frame_indices: Any) -> np.ndarray:
        frames = np.atleast_1d(frame_indices)
        if len(self._instants) == 1:
            return np.repeat(self._knots, len(frames), axis=0)
        before = np.clip(np.searchsorted(self._instants, frames) - 1, 0, len(self._instants) - 2)
        first, last = self._instants[before], self._instants[before + 1]
        share = ((frames - first) / (last - first))[:, None, None]
        return (1 - share) * self._knots[before] + share * self._knots[before + 1]


class Linear:
    def fit(self, instants: np.ndarray, homographies: np.ndarray, information: np.ndarray | None) -> Knots:
        return Knots(instants, homographies)


def _truth(moving: Group, fixed: Group, found: Located) -> Located:
    return found


@pytest.fixture
def with_report() -> None:
    """Draw the report of a run, which takes longer than a small run itself."""


@pytest.fixture(autouse=True)
def report_if_asked(request: pytest.FixtureRequest) -> None:
    if "with_report" not in request.fixturenames:
        request.getfixturevalue("without_report")


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Keep libraries from starting threads, as in a run."""
    with one_thread_inside():
        yield


@pytest.fixture
def make_level() -> Callable[..., Level]:
    """Build a level: `make_level(motion, answer, number, scale)`, other components by their kinds, fallbacks by their names.

    The motion is a pan of 0.3 px a frame unless another is given.
    `answer(moving, fixed, found)` gets the groups of a pair and its true motion, and returns what the locator returns.
    """

    def make(
        motion: Trajectory = STEADY,
        answer: Callable[..., Any] = _truth,
        number: int = 1,
        scale: float = 1.0,
        fallbacks: Mapping[str, Any] | None = None,
        locator: Any = None,
        **components: Any,
    ) -> Level:
        named = {"toy": locator or Knowing(motion, answer)} | (fallbacks or {})

        def of_toys(component: Any, kind: str, name: str = "toy") -> Any:
            return attributed(component, f"{kind} {name!r} of toys 1.0", f"level {number}")

        locators = tuple(NamedLocator(name, of_toys(each, "locator", name)) for name, each in named.items())
        toys = {"resampler": SideBySide(), "merger": Noise(), "interpolator": Linear()} | components
        return Level(
            number=number, scale=scale, locators=locators, **{kind: of_toys(each, kind) for kind, each in toys.items()}
        )

    return make
