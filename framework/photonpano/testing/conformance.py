"""Checks of every contribution, and of components built for a capture; results compared bit by bit, and in several threads."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
import pickle
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Barrier
from typing import Any, ClassVar, TypeAlias, TypeVar

import numpy as np
import pytest
from numpy.random.mtrand import get_bit_generator, set_bit_generator
from pydantic import BaseModel

from photonpano.contracts.requirements import BrokenContract
from photonpano.errors import CaptureUnreadError, PluginError
from photonpano.photometry import BinaryResponse
from photonpano.plugins.contributions import KINDS, Contribution, StageContext, StageContribution, install_command
from photonpano.values import CaptureSummary, StreamInfo

T = TypeVar("T")

THREADS = 4
STREAM = StreamInfo(2000, 254, 496, frame_rate_hz=96_800.0)  # the capture for which components are built by default
SUMMARY = CaptureSummary(flux=0.5, speed_px=0.15, how="set by the conformance kit")
# What a component returned, described for messages; the value; and what a run requires of it.
Answer: TypeAlias = tuple[str, Any, Callable[[Any], object]]


def fingerprint(value: Any) -> object:
    """Return a value that is equal for results with the same bytes; unlike `==`, also for NaN.

    Arrays become hashes: pytest would compare megabytes letter by letter to explain how they differ.
    """
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [fingerprint(getattr(value, field.name)) for field in dataclasses.fields(value)]
        return type(value).__name__, *fields
    if isinstance(value, Mapping):
        return tuple((key, fingerprint(item)) for key, item in value.items())
    if isinstance(value, list | tuple):
        return tuple(fingerprint(item) for item in value)
    return repr(value)


@contextmanager
def global_seed(seed: int) -> Iterator[None]:
    """Seed numpy's global generator, on which no component may depend, within a block."""
    before = get_bit_generator()
    set_bit_generator(np.random.MT19937(seed))
    try:
        yield
    finally:
        set_bit_generator(before)


def in_threads(work: Callable[[int], T]) -> list[T]:
    """Call `work(number)` in `THREADS` threads that start together, and return all results."""
    together = Barrier(THREADS)

    def start(number: int) -> T:
        together.wait()
        return work(number)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(start, range(THREADS)))


def copied(value: T, what: str) -> T:
    """Return a copy as another process would get it; fail with a message if it cannot travel there."""
    try:
        copy: T = pickle.loads(pickle.dumps(value))
    except Exception as error:
        raise AssertionError(
            f"{what} must survive pickling, so that other processes can use it; keep functions and classes at the top of a "
            f"module, and drop locks and open files in __getstate__ ({type(error).__name__}: {error})"
        ) from error
    return copy


@pytest.mark.usefixtures("photonpano_one_thread_inside")
class Conformance:
    """Checks of the config. Subclasses for each kind add checks of its components."""

    kind: ClassVar[str]

    contribution: Contribution  # the contribution under test; set it in a subclass
    config: Mapping[str, Any] = {}  # the keys under `with`. Set it on `self` in a fixture with `autouse=True` if it needs files

    def settings(self) -> Any:
        """Return the config under test."""
        return self.contribution.config.model_validate(dict(self.config))

    def require_libraries(self) -> None:
        """Skip a test if a library that the contribution requires is not installed."""
        for requirement in self.contribution.requires:
            if importlib.util.find_spec(requirement.module) is None:
                pytest.skip(f"{self.contribution.name} needs {requirement.module}: {install_command([requirement])}")

    def test_contribution_has_the_kind_of_this_class(self) -> None:
        """Specs look up components by kind."""
        assert isinstance(self.contribution, KINDS[self.kind].contribution), f"{type(self).__name__} tests a {self.kind}"

    def test_config_is_closed_and_frozen(self) -> None:
        """A misspelt key is an error, and no component can modify a config that others share."""
        for model in models_in(self.contribution.config):
            extra, frozen = model.model_config.get("extra"), model.model_config.get("frozen")
            assert (extra, frozen) == ("forbid", True), f"derive {model.__name__} from photonpano.Config"

    def test_config_survives_json_round_trip(self) -> None:
        """`run.json` contains the spec, from which a run can be repeated."""
        settings = self.settings()
        written = json.loads(json.dumps(settings.model_dump(mode="json")))
        assert self.contribution.config.model_validate(written) == settings


class StageConformance(Conformance):
    """Checks of components that are built for a capture."""

    contribution: StageContribution

    def built(self, stream: StreamInfo = STREAM, threads: int = 1) -> Any:
        """Build the component for a capture; its summary is available only afterwards."""
        self.require_libraries()
        is_built = False

        def summary() -> CaptureSummary:
            if not is_built:
                raise CaptureUnreadError("build() must not call context.capture(); call it when the component is used")
            return SUMMARY

        context = StageContext(stream, BinaryResponse(), seed=0, threads=threads, capture=summary)
        component = self.contribution.build(self.settings(), context)
        is_built = True
        return component

    def test_build_reads_no_frames(self) -> None:
        """`photonpano check` and `explain` build components without reading frames."""
        component = self.built()
        missing = [name for name in KINDS[self.kind].methods if not callable(getattr(component, name, None))]
        assert not missing, f"a {self.kind} needs these methods"

    def test_check_accepts_config_under_test(self) -> None:
        """`check` returns a sequence of sentences, empty if there is no problem."""
        assert [*self.contribution.check(self.settings(), STREAM)] == []


class AnswerConformance(StageConformance, ABC):
    """Checks of components whose answers a run checks."""

    @abstractmethod
    def answers(self) -> Iterator[Answer]:
        """Yield what the component returns for several inputs."""

    def test_answers_keep_the_contract(self) -> None:
        """A run refuses what breaks it: see `photonpano.contracts`. Arguments are read-only: copy an array to change it."""
        for what, found, require in self.answers():
            with passing(what):
                require(found)


@contextmanager
def passing(what: str) -> Iterator[None]:
    """Fail with a message if a check of a run, called in the block, refuses what a component returned."""
    try:
        yield
    except (BrokenContract, PluginError) as error:
        raise AssertionError(f"a run refuses {what}: {error}") from error


def models_in(config: type[BaseModel]) -> list[type[BaseModel]]:
    """Return a config model and all models nested in it, each once."""
    found = [config]
    for model in found:  # grows meanwhile
        found += [each for field in model.model_fields.values() for each in _models(field.annotation) if each not in found]
    return found


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in typing.get_args(annotation):
        yield from _models(argument)
