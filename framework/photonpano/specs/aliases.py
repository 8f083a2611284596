"""Contributions that stand for others: a section that uses one is rewritten into one that uses those."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn

from photonpano.contributions import LocatorContribution, SourceContribution
from photonpano.errors import PluginError

if TYPE_CHECKING:
    from collections.abc import Callable

    from photonpano.specs.written import WrittenSpec


def _unbuilt(*_: object) -> NoReturn:
    raise PluginError("this name stands for other components, which a spec that uses it is resolved to; build those")


@dataclass(frozen=True, kw_only=True)
class Alias:
    """A name that stands for other components, so that nothing is built of it.

    Attributes:
        expand: rewrites a section: takes the section, its path and the spec, and returns a section that uses other components,
            or None if there are problems. It adds the problems to the spec, and enters the places of values that move.
    """

    expand: Callable[[dict[str, Any], str, WrittenSpec], dict[str, Any] | None]
    build: Callable[[Any, Any], Any] = _unbuilt


@dataclass(frozen=True, kw_only=True)
class SourceAlias(Alias, SourceContribution):
    """Stands for a source."""


@dataclass(frozen=True, kw_only=True)
class LocatorAlias(Alias, LocatorContribution):
    """Stands for a locator and its fallbacks; its config lists locators under `backends`."""
