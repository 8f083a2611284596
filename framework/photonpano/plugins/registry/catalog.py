"""The catalog: what the installed plugins offer, and which plugins are broken or disabled."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass, replace

import pluggy

from photonpano.errors import PluginError
from photonpano.plugins.contributions import KINDS, Contribution, Requirement, install_command
from photonpano.plugins.registry.plugins import OBSERVATION_HOOKS, contributions_of, observation_of, require_same_contract
from photonpano.text import listed, suggestion


@dataclass(frozen=True, slots=True, order=True)
class Origin:
    """The plugin that something comes from."""

    plugin: str  # its distribution, such as "photonpano"
    version: str
    entry_point: str  # how the distribution names the plugin, such as "core = photonpano_core.hooks"

    def label(self, kind: str, name: str) -> str:
        """Return the name of a component for messages, such as "merger 'photon-mle' of photonpano 0.1.0"."""
        return f"{kind} {name!r} of {self.plugin} {self.version}"

    def __str__(self) -> str:
        return f"{self.plugin} {self.version} ({self.entry_point})"


@dataclass(frozen=True, slots=True)
class Entry:
    """One component on offer, with the libraries that it needs and that are missing."""

    contribution: Contribution
    origin: Origin
    missing: tuple[Requirement, ...] = ()

    @property
    def kind(self) -> str:
        """The kind of the component, such as "locator"."""
        return self.contribution.kind

    @property
    def name(self) -> str:
        """The name of the component in specs."""
        return self.contribution.name

    @property
    def label(self) -> str:
        """Kind, name, distribution and version, for messages."""
        return self.origin.label(self.kind, self.name)

    @property
    def unavailable(self) -> str | None:
        """Why the component cannot be built here, and the line that installs what is missing; None if it can."""
        if not self.missing:
            return None
        modules = listed(requirement.module for requirement in self.missing)
        are = "is" if len(self.missing) == 1 else "are"
        return f"the {self.kind} {self.name!r} needs {modules}, which {are} not installed: {install_command(self.missing)}"


@dataclass(frozen=True, slots=True)
class BrokenPlugin:
    """A plugin that failed to load, and offers nothing, with what went wrong, in a line."""

    origin: Origin
    error: str

    def __str__(self) -> str:
        return f"{self.origin}: {self.error}"


@dataclass(frozen=True, slots=True)
class DisabledPlugin:
    """A plugin that was not imported, and what disables it, such as "PHOTONPANO_DISABLE_PLUGINS=core"."""

    origin: Origin
    by: str

    def __str__(self) -> str:
        return f"{self.origin}, by {self.by}"


@dataclass(frozen=True, slots=True)
class Observer:
    """A plugin with observation hooks; `hook` calls them by their names, and one that the plugin lacks does nothing."""

    origin: Origin
    hook: pluggy.HookRelay

    @property
    def watches(self) -> tuple[str, ...]:
        """The names of the observation hooks that the plugin has."""
        return tuple(name for name in OBSERVATION_HOOKS if getattr(self.hook, name).get_hookimpls())


@dataclass(frozen=True, slots=True)
class Catalog:
    """What can be chosen in a spec. `discover()` makes one from the installed plugins; `Catalog()` is empty."""

    rows: tuple[Entry, ...] = ()  # every component on offer, ordered by kind and name
    broken: tuple[BrokenPlugin, ...] = ()  # the plugins that failed; none of their components is on offer
    disabled: tuple[DisabledPlugin, ...] = ()  # the plugins that were not imported, so that their components are not known
    observers: tuple[Observer, ...] = ()  # the plugins that watch runs

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names on offer for a kind, such as "locator", in alphabetical order."""
        return tuple(sorted({entry.name for entry in self.rows if entry.kind == kind}))

    def entries(self, kind: str, name: object) -> list[Entry]:
        """Return the components of a name: one, none, or several if several plugins offer it."""
        return [entry for entry in self.rows if (entry.kind, entry.name) == (kind, name)]

    def keys_of(self, kind: str, name: object) -> Iterable[str]:
        """Return the keys of the component with this name; none if there is no such component."""
        return next((each.contribution.config.model_fields for each in self.entries(kind, name)), ())

    def find(self, kind: str, name: str) -> Entry:
        """Look a component up, whether or not its libraries are installed: see `Entry.unavailable`.

        Args:
            kind: "source", "resampler", "merger", "locator", "interpolator", "refiner", "renderer", "exporter",
                "pose-estimator" or "executor".
            name: the name of the component in specs.

        Raises:
            PluginError: no plugin offers the name (the message has the nearest names, and the plugins that are broken or
                disabled), or several do.
        """
        found = self.entries(kind, name)
        if not found:
            raise PluginError(self.unknown(kind, name))
        if len(found) > 1:
            origins = listed(str(entry.origin) for entry in found)
            raise PluginError(f"the {kind} {name!r} is offered by {origins}; uninstall or disable all but one")
        return found[0]

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
            given: tuple[Contribution, ...]
            if isinstance(offer, Contribution):
                require_same_contract(offer)
                given = (offer,)
            else:
                given = contributions_of(offer)
                if hook := observation_of(offer):
                    observers.append(Observer(_given_in_python(getattr(offer, "__name__", type(offer).__name__)), hook))
            added += [make_entry(each, _given_in_python(each.build.__module__)) for each in given]
        return replace(self, rows=ordered([*self.rows, *added]), observers=tuple(observers))

    def unknown(self, kind: str | None, name: str) -> str:
        """Return the message for a name that no plugin offers: with the nearest names, and the plugins that might offer it.

        Args:
            kind: such as "locator"; None if any would do.
            name: the name that was looked up.
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


def make_entry(contribution: Contribution, origin: Origin) -> Entry:
    """Make the entry of a contribution; finds its missing libraries without importing any."""
    return Entry(contribution, origin, tuple(each for each in contribution.requires if not _is_installed(each.module)))


def ordered(rows: list[Entry]) -> tuple[Entry, ...]:
    """Order entries by kind, then name, then origin."""
    kinds = list(KINDS)
    return tuple(sorted(rows, key=lambda entry: (kinds.index(entry.kind), entry.name, entry.origin)))


def _given_in_python(module: str) -> Origin:
    return Origin(module, "unreleased", "given in Python")


def _is_installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the package that a dotted name stands in
        return False
