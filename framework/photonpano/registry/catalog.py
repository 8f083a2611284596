"""The catalog: what the installed plugins offer, and which of them are broken."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from photonpano.contributions import Contribution
from photonpano.errors import PluginError
from photonpano.registry.kinds import KINDS
from photonpano.registry.observers import Observer
from photonpano.registry.plugins import contributions_of, observation_of, require_same_contract
from photonpano.text import listed, suggestion

if TYPE_CHECKING:
    from photonpano.contributions import AnyContribution, Requirement


@dataclass(frozen=True, slots=True)
class Entry:
    """One component on offer, and where it comes from.

    Attributes:
        contribution: the record of the component.
        plugin: the distribution it came from, such as "photonpano".
        version: the version of that distribution.
        entry_point: how the distribution names the plugin, such as "core = photonpano_core.hooks".
        missing: libraries that the component needs and that are not installed.
    """

    contribution: AnyContribution
    plugin: str
    version: str
    entry_point: str
    missing: tuple[Requirement, ...] = ()

    @property
    def kind(self) -> str:
        """The kind of the component, such as "locator"."""
        return self.contribution.kind

    @property
    def name(self) -> str:
        """What specs call the component."""
        return self.contribution.name

    @property
    def origin(self) -> str:
        """Distribution, version and entry point, for messages."""
        return f"{self.plugin} {self.version} ({self.entry_point})"

    @property
    def unavailable(self) -> str | None:
        """Why the component cannot be built here, with the line that installs what it lacks; None if it can."""
        if not self.missing:
            return None
        modules = listed(requirement.module for requirement in self.missing)
        packages = " ".join(f'"{install}"' for install in dict.fromkeys(each.install for each in self.missing))
        are = "is" if len(self.missing) == 1 else "are"
        return f"the {self.kind} {self.name!r} needs {modules}, which {are} not installed: pip install {packages}"


@dataclass(frozen=True, slots=True)
class BrokenPlugin:
    """A plugin that offers nothing because something is wrong with it.

    Attributes:
        plugin: its distribution.
        version: the version of that distribution.
        entry_point: how the distribution names the plugin, such as "core = photonpano_core.hooks".
        error: what went wrong, in a line.
    """

    plugin: str
    version: str
    entry_point: str
    error: str

    def __str__(self) -> str:
        return f"{self.plugin} {self.version} ({self.entry_point}): {self.error}"


@dataclass(frozen=True, slots=True)
class DisabledPlugin:
    """A plugin that was not imported, because the environment says so.

    Attributes:
        plugin: its distribution.
        version: the version of that distribution.
        entry_point: how the distribution names the plugin, such as "core = photonpano_core.hooks".
        by: what disables it, such as "PHOTONPANO_DISABLE_PLUGINS=core".
    """

    plugin: str
    version: str
    entry_point: str
    by: str

    def __str__(self) -> str:
        return f"{self.plugin} {self.version} ({self.entry_point}), by {self.by}"


@dataclass(frozen=True, slots=True)
class Catalog:
    """What can be chosen in a spec. `discover()` makes one from the installed plugins; `Catalog()` is empty.

    Attributes:
        rows: every component on offer, ordered by kind and name.
        broken: the plugins that failed; none of their components is on offer.
        disabled: the plugins that were not imported; what they offer is not known.
        observers: the plugins that watch runs.
    """

    rows: tuple[Entry, ...] = ()
    broken: tuple[BrokenPlugin, ...] = ()
    disabled: tuple[DisabledPlugin, ...] = ()
    observers: tuple[Observer, ...] = ()

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names on offer for a kind, such as "locator", in alphabetical order."""
        return tuple(sorted({entry.name for entry in self.rows if entry.kind == kind}))

    def find(self, kind: str, name: str) -> Entry:
        """Look a component up, whether or not its libraries are installed.

        Args:
            kind: "source", "resampler", "merger", "locator" or "interpolator".
            name: what specs call it.

        Raises:
            PluginError: no plugin offers the name (says the nearest ones, and which plugins are broken
                or disabled), or several do.
        """
        found = [entry for entry in self.rows if entry.kind == kind and entry.name == name]
        if not found:
            raise PluginError(self.unknown(kind, name))
        if len(found) > 1:
            origins = listed(entry.origin for entry in found)
            raise PluginError(f"the {kind} {name!r} is offered by {origins}; uninstall or disable all but one")
        return found[0]

    def get(self, kind: str, name: str) -> Entry:
        """Look a component up that is to be built.

        Args:
            kind: "source", "resampler", "merger", "locator" or "interpolator".
            name: what specs call it.

        Raises:
            PluginError: as `find`, or a library that the component needs is not installed (says how to install it).
        """
        entry = self.find(kind, name)
        if entry.unavailable:
            raise PluginError(entry.unavailable)
        return entry

    def including(self, *offers: object) -> Catalog:
        """Return a catalog that also offers these, for notebooks and tests.

        Args:
            offers: contributions, or plugins (modules with hooks).

        Raises:
            PluginError: one of the plugins is broken.
        """
        added: list[Entry] = []
        observers = list(self.observers)
        for offer in offers:
            if isinstance(offer, Contribution):
                require_same_contract(offer)
                given: tuple[AnyContribution, ...] = (offer,)
            else:
                given = contributions_of(offer)
                if hook := observation_of(offer):
                    name = getattr(offer, "__name__", type(offer).__name__)
                    observers.append(Observer(name, "unreleased", "given in Python", hook))
            added += [make_entry(each, each.build.__module__, "unreleased", "given in Python") for each in given]
        return replace(self, rows=ordered([*self.rows, *added]), observers=tuple(observers))

    def unknown(self, kind: str | None, name: str) -> str:
        """Say that no plugin offers a name: the nearest ones, and which plugins might, were they not broken or disabled.

        Args:
            kind: such as "locator"; None if any would do.
            name: what was asked for.
        """
        message = f"there is no {kind or 'component'} {name!r}"
        others = [entry.kind for entry in self.rows if entry.name == name]
        near = suggestion(name, {entry.name for entry in self.rows if kind in (None, entry.kind)})
        if hint := f"it is one of the {others[0]}s" if others else near:
            message += f"; {hint}"
        for state, plugins in (("Broken", self.broken), ("Disabled", self.disabled)):
            if plugins:
                stop = " " if message.endswith("?") else ". "
                message += f"{stop}{state} plugins may have offered it: {listed(map(str, plugins))}"
        return message


def make_entry(contribution: AnyContribution, plugin: str, version: str, entry_point: str) -> Entry:
    """Make the entry of a contribution; finds out which of its libraries are missing, without importing them."""
    missing = tuple(each for each in contribution.requires if not _is_installed(each.module))
    return Entry(contribution, plugin, version, entry_point, missing)


def ordered(rows: list[Entry]) -> tuple[Entry, ...]:
    """Order entries by kind, then name, then origin."""
    kinds = list(KINDS)
    return tuple(sorted(rows, key=lambda entry: (kinds.index(entry.kind), entry.name, entry.origin)))


def _is_installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package that a dotted name stands in
        return False
