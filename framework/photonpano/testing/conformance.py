"""Checks of every contribution, and of the components that are built for a capture."""

from __future__ import annotations

import importlib.util
import json
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, TypeAlias

import pytest
from pydantic import BaseModel

from photonpano.contracts.requirements import BrokenContract
from photonpano.errors import CaptureUnreadError, PluginError
from photonpano.photometry import BinaryResponse
from photonpano.plugins.contributions import Contribution, StageContext, StageContribution, install_command
from photonpano.plugins.registry import KINDS
from photonpano.values import CaptureSummary, StreamInfo

STREAM = StreamInfo(2000, 254, 496, frame_rate_hz=96_800.0)  # the capture for which components are built by default
SUMMARY = CaptureSummary(flux=0.5, speed_px=0.15, how="set by the conformance kit")
# What a component returned, described for messages; the value; and what a run requires of it.
Answer: TypeAlias = tuple[str, Any, Callable[[Any], object]]


@pytest.mark.usefixtures("photonpano_one_thread_inside")
class Conformance:
    """Checks of the config. Subclasses for each kind add checks of its components.

    Attributes:
        contribution: the contribution under test; set it in a subclass.
        config: the keys under `with`. Set it on `self` in a fixture with `autouse=True` if it needs files.
    """

    kind: ClassVar[str]

    contribution: Contribution
    config: Mapping[str, Any] = {}

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
