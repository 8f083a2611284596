"""From a plan to components: each built once, with errors that name the plugin."""

from __future__ import annotations

import importlib.util
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, cast

from photonpano.contributions import SourceContext, StageContext
from photonpano.errors import PhotonpanoError, PluginError
from photonpano.pipeline.threads import thread_count

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from photonpano.contributions import Contribution
    from photonpano.protocols import Interpolator, Locator, Merger, Resampler, Source
    from photonpano.spec.plan import Choice, Plan

ContextT = TypeVar("ContextT")
ComponentT = TypeVar("ComponentT")


@dataclass(frozen=True, slots=True)
class Level:
    """The components of one level, built.

    Attributes:
        number: from 1.
        scale: pixels of the level's exposures per pixel of a frame.
        origins: who provides the component of each kind, such as "merger 'photon-mle' of photonpano 0.1.0".
    """

    number: int
    scale: float
    resampler: Resampler
    merger: Merger
    locator: Locator
    interpolator: Interpolator
    origins: Mapping[str, str]

    @contextmanager
    def blaming(self, kind: str) -> Iterator[None]:
        """Name the component of a kind, such as "merger", in what it raises by mistake.

        Raises:
            PluginError: the block raised something that was not made for users.
        """
        try:
            yield
        except PhotonpanoError:
            raise
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise PluginError(f"{self.origins[kind]} failed at level {self.number}: {reason}") from error


def build_source(plan: Plan) -> Source:
    """Open the capture of a plan.

    Raises:
        InputError: the capture cannot be used as it is.
        PluginError: a library is missing, or the plugin failed in its own way.
    """
    return _built(plan.source, SourceContext(plan.run.seed, thread_count(plan.run)))


def build_levels(plan: Plan, source: Source) -> tuple[Level, ...]:
    """Build the components of all levels; levels that choose alike share one component."""
    context = StageContext(source.info, source.response, plan.run.seed, thread_count(plan.run))
    made: list[tuple[Choice[Any], Any]] = []

    def component(choice: Choice[Contribution[Any, StageContext, ComponentT]]) -> ComponentT:
        for known, value in made:
            if known.contribution is choice.contribution and known.config == choice.config:
                return cast("ComponentT", value)
        value = _built(choice, context)
        made.append((choice, value))
        return value

    return tuple(
        Level(
            number,
            level.scale,
            component(level.resample),
            component(level.merge),
            component(level.locate),
            component(level.interpolate),
            {
                choice.contribution.kind: _origin(choice)
                for choice in (level.resample, level.merge, level.locate, level.interpolate)
            },
        )
        for number, level in enumerate(plan.levels, start=1)
    )


def _built(choice: Choice[Contribution[Any, ContextT, ComponentT]], context: ContextT) -> ComponentT:
    contribution = choice.contribution
    who = _origin(choice)
    for requirement in contribution.requires:
        if importlib.util.find_spec(requirement.module) is None:
            raise PluginError(f'{who} needs {requirement.module}: run pip install "{requirement.install}"')
    try:
        return contribution.build(choice.config, context)
    except PhotonpanoError:
        raise
    except Exception as error:
        raise PluginError(f"{who} could not be built: {type(error).__name__}: {error}") from error


def _origin(choice: Choice[Contribution[Any, Any, Any]]) -> str:
    return f"{choice.contribution.kind} {choice.contribution.name!r} of {choice.plugin} {choice.version}"
