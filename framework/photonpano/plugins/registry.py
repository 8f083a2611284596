"""Find the plugins that are installed, and the catalog of what they contribute."""

from __future__ import annotations

import importlib.util
import logging
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import pluggy

from photonpano.errors import PluginError, described
from photonpano.plugins import hookspecs
from photonpano.plugins.contributions import (
    API_VERSION,
    KINDS,
    PROJECT,
    Contribution,
    Kind,
    Requirement,
    RunKindContribution,
    hookspec,
    install_command,
)
from photonpano.text import listed, suggestion

PREFIX = f"{PROJECT}_"
# The hooks of the framework: those that offer components, in the order in which a run needs these, and those that watch.
HOOKS = tuple(name for name in vars(hookspecs) if name.startswith(PREFIX))
# The hooks that offer nothing: a run calls them, so that a plugin can watch it.
OBSERVATION_HOOKS = tuple(name for name in HOOKS if name not in {kind.hook for kind in KINDS.values()})
logger = logging.getLogger(__name__)

DISABLE = "PHOTONPANO_DISABLE_PLUGINS"  # an environment variable: names of distributions or entry points, separated by commas


def contributions_of(plugin: object) -> tuple[Contribution, ...]:
    """Call the hooks of one plugin, a module or any object, that offer components, and check what they return.

    Raises:
        PluginError: a hook is unknown, lacks its mark, takes arguments that it does not have, raises, or offers something of
            another kind or for another version of the contract.
    """
    manager = _registered(plugin)
    return tuple(contribution for kind in KINDS.values() for contribution in _offered(manager, kind))


def observation_of(plugin: object) -> pluggy.HookRelay | None:
    """Return the caller of a plugin's observation hooks, None if it has none; errors as in `contributions_of`."""
    manager = _registered(plugin)
    implemented = {caller.name for caller in manager.get_hookcallers(plugin) or ()}
    return manager.hook if implemented.intersection(OBSERVATION_HOOKS) else None


def require_same_contract(contribution: Contribution) -> None:
    """Raise `PluginError` if a contribution was made for another version of the contract."""
    made_for = contribution.api_version
    if made_for == API_VERSION:
        return
    raise PluginError(
        f"{_short(contribution)} was made for version {made_for} of the plugin contract, and this photonpano has version "
        f"{API_VERSION}; upgrade {'the plugin' if made_for < API_VERSION else 'photonpano'}"
    )


def _registered(plugin: object) -> pluggy.PluginManager:
    """Register a plugin with a manager of its own, so that its mistakes affect no other plugin."""
    manager = pluggy.PluginManager(PROJECT)
    manager.add_hookspecs(hookspecs)
    of_plugins = [kind.hook for kind in KINDS.values() if kind.hook not in HOOKS]
    for name in of_plugins:
        manager.add_hookspecs(type(name, (), {name: hookspec(lambda: ())}))
    for name in dir(plugin):
        if not name.startswith(PREFIX) or not callable(getattr(plugin, name)):
            continue
        if name not in (*HOOKS, *of_plugins):  # which pluggy would ignore
            raise PluginError(f"there is no hook {name!r}; known: {listed((*HOOKS, *of_plugins))}")
        if manager.parse_hookimpl_opts(plugin, name) is None:
            raise PluginError(f"{name} is not marked with @photonpano.hookimpl")
    try:
        manager.register(plugin)
        manager.check_pending()
    except pluggy.PluginValidationError as error:
        raise PluginError(" ".join(str(error).split())) from error
    return manager


def _offered(manager: pluggy.PluginManager, kind: Kind) -> list[Contribution]:
    try:
        results: list[Any] = getattr(manager.hook, kind.hook)()
        offered = [item for each in results for item in ([each] if isinstance(each, Contribution) else each)]
    except Exception as error:
        raise PluginError(f"{kind.hook} raised {described(error)}") from error
    for item in offered:
        if not isinstance(item, kind.contribution):
            raise PluginError(f"{kind.hook} offers {_short(item)}, expected a {kind.contribution.__name__}")
        require_same_contract(item)
    return offered


def _short(item: object) -> str:
    return f"the {item.kind} {item.name!r}" if isinstance(item, Contribution) else f"{item!r:.60}"


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

    @property
    def run_kinds(self) -> dict[str, RunKindContribution]:
        """The kinds of runs on offer that find something else than a panorama, by the sections that ask for them."""
        offered = (entry.contribution for entry in self.rows)
        return {each.section: each for each in offered if isinstance(each, RunKindContribution)}

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
            kind: "source", "resampler", "merger", "locator", "interpolator", "refiner", "renderer", "exporter", "run-kind",
                "executor", or a kind that a plugin has defined.
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
        """Return a catalog that also offers contributions, or plugins (modules with hooks), for notebooks and tests.

        Raises a `PluginError` if one of the plugins is broken.
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

        `kind` is such as "locator"; None if any would do.
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


def discover() -> Catalog:
    """Load every plugin in the entry-point group `photonpano` and collect what they offer.

    Never raises for what a plugin does wrong: see `Catalog.broken`. A plugin is taken whole or not at all. A plugin that the
    environment variable `PHOTONPANO_DISABLE_PLUGINS` names, by its distribution or its entry point, is not imported: see
    `Catalog.disabled`. Names in the variable that are no plugin's are logged as a warning.
    """
    rows: list[Entry] = []
    broken: list[BrokenPlugin] = []
    disabled: list[DisabledPlugin] = []
    observers: list[Observer] = []
    words = [word.strip() for word in os.environ.get(DISABLE, "").split(",")]
    disabling = {_canonical(word): word for word in words if word}
    names: set[str] = set()
    for entry_point in entry_points(group=PROJECT):
        origin = _origin(entry_point)
        names |= {entry_point.name, origin.plugin}
        if by := disabling.get(_canonical(entry_point.name)) or disabling.get(_canonical(origin.plugin)):
            disabled.append(DisabledPlugin(origin, f"{DISABLE}={by}"))
            continue
        try:
            loaded = entry_point.load()
            hook = observation_of(loaded)
            rows += [make_entry(contribution, origin) for contribution in contributions_of(loaded)]
            if hook:
                observers.append(Observer(origin, hook))
        except Exception as error:  # whatever is wrong with a plugin, it is a row
            message = str(error) if isinstance(error, PluginError) else described(error)
            broken.append(BrokenPlugin(origin, " ".join(message.split())))
    if unknown := [word for key, word in disabling.items() if key not in set(map(_canonical, names))]:
        hint = suggestion(unknown[0], names) if len(unknown) == 1 else f"known: {listed(sorted(names))}"
        are = "is no installed plugin" if len(unknown) == 1 else "are no installed plugins"
        logger.warning("%s names %s, which %s; %s", DISABLE, listed(map(repr, unknown)), are, hint)
    return Catalog(
        ordered(rows),
        tuple(sorted(broken, key=str)),
        tuple(sorted(disabled, key=str)),
        tuple(sorted(observers, key=lambda observer: observer.origin)),
    )


def _canonical(name: str) -> str:
    """Return a name as those of packages are compared: without regard to case, and to the choice of `-`, `_` and `.`."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _origin(entry_point: EntryPoint) -> Origin:
    """Return the origin of a plugin; the metadata of a damaged installation may lack name or version."""
    metadata = None
    with suppress(OSError):  # where a library has brought importlib_metadata, that raises for missing metadata
        metadata = entry_point.dist.metadata if entry_point.dist else None
    name, version = (metadata.get_all(key, ["unknown"])[0] if metadata else "unknown" for key in ("Name", "Version"))
    return Origin(name, version, f"{entry_point.name} = {entry_point.value}")
