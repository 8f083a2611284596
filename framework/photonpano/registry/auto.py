"""`auto`: a name for the source that recognises a capture, which the framework finds by asking all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from pydantic import Field

from photonpano.contributions import Config, Recognised, SourceContribution, SpecPath
from photonpano.errors import PluginError

if TYPE_CHECKING:
    from pathlib import Path

    from photonpano.contributions import SourceContext
    from photonpano.protocols import Source
    from photonpano.registry.catalog import Catalog, Entry


class AutoConfig(Config):
    """A capture of any kind."""

    path: SpecPath = Field(description="the file or folder; other keys are passed to the source that recognises it")


def _build(config: AutoConfig, context: SourceContext) -> Source:
    del config, context
    raise PluginError(f"{AUTO.name} stands for the source that recognises a path: build that, as specs that name it do")


AUTO = SourceContribution(
    name="auto",
    summary="The source that recognises the file or folder",
    config=AutoConfig,
    build=_build,
)
"""What the framework itself offers. A spec that uses it is resolved into the source that recognises the path, so that nothing
is ever built of it."""


@dataclass(frozen=True, slots=True)
class Answers:
    """What the sources of a catalog say of a path.

    Attributes:
        recognised: who takes it for its own, and why.
        failures: a clause for each source that raised, or returned something else.
    """

    recognised: tuple[tuple[Entry, Recognised], ...]
    failures: tuple[str, ...]


def ask_sources(catalog: Catalog, path: Path) -> Answers:
    """Show a path to all sources of a catalog; one that fails keeps none of the others from being asked."""
    recognised: list[tuple[Entry, Recognised]] = []
    failures: list[str] = []
    for entry in catalog.rows:
        if not isinstance(entry.contribution, SourceContribution):
            continue
        who = f"recognise of the {entry.label}"
        try:
            answer = entry.contribution.recognise(path)
        except Exception as error:
            failures.append(f"{who} raised {type(error).__name__}: {error}")
            continue
        if isinstance(answer, Recognised):
            recognised.append((entry, answer))
        elif answer is not None:
            failures.append(f"{who} returned a {type(answer).__name__}, expected a Recognised or None")
    return Answers(tuple(recognised), tuple(failures))
