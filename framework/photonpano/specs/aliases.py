"""Contributions that stand for others: a section that uses one is rewritten into one that uses those."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

from photonpano.contributions import LocatorContribution, SourceContribution
from photonpano.errors import PluginError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from photonpano.registry import Catalog
    from photonpano.specs.written import WrittenSpec
    from photonpano.values import Decision


@dataclass(frozen=True, slots=True)
class Use:
    """A section that uses an alias, and what is needed to rewrite it.

    Attributes:
        section: the keys of the section, `use` among them.
        where: the path of the section.
        spec: the spec; problems are added to it, and the places of values that move are entered in it.
        catalog: what can be chosen.
        directory: what relative paths count from.
        decisions: what the alias has chosen, and why, is added here.
    """

    section: dict[str, Any]
    where: str
    spec: WrittenSpec
    catalog: Catalog
    directory: Path
    decisions: list[Decision]


def _unbuilt(*_: object) -> NoReturn:
    raise PluginError("this name stands for other components, which a spec that uses it is resolved to; build those")


@dataclass(frozen=True, kw_only=True)
class Alias:
    """A name that stands for other components, so that nothing is built of it.

    Attributes:
        expand: rewrites a section into one that uses other components; None if it has problems.
    """

    expand: Callable[[Use], dict[str, Any] | None]
    build: Callable[[Any, Any], Any] = _unbuilt


@dataclass(frozen=True, kw_only=True)
class SourceAlias(Alias, SourceContribution):
    """Stands for a source."""


@dataclass(frozen=True, kw_only=True)
class LocatorAlias(Alias, LocatorContribution):
    """Stands for a locator and its fallbacks."""
