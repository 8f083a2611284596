"""Call the hooks of one plugin, and check what they return."""

from __future__ import annotations

from itertools import islice
from typing import Any

import pluggy

from photonpano.errors import PluginError, described
from photonpano.plugins import hookspecs
from photonpano.plugins.contributions import API_VERSION, KINDS, PROJECT, Contribution, Kind
from photonpano.text import listed

PREFIX = f"{PROJECT}_"
# All hooks: those that offer components, in the order in which a run needs these, and those that watch.
HOOKS = tuple(name for name in vars(hookspecs) if name.startswith(PREFIX))
# The hooks that offer nothing: a run calls them, so that a plugin can watch it.
OBSERVATION_HOOKS = tuple(name for name in HOOKS if name not in {kind.hook for kind in KINDS.values()})
MAX_OFFERED = 1000  # maximum number of components of a hook


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
    for name in dir(plugin):
        if not name.startswith(PREFIX) or not callable(getattr(plugin, name)):
            continue
        if name not in HOOKS:  # which pluggy would ignore
            raise PluginError(f"there is no hook {name!r}; known: {listed(HOOKS)}")
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
        offered = [item for result in results for item in _items(result)]
    except Exception as error:
        raise PluginError(f"{kind.hook} raised {described(error)}") from error
    if len(offered) > MAX_OFFERED:
        raise PluginError(f"{kind.hook} offers more than {MAX_OFFERED} components; does it end?")
    for item in offered:
        if not isinstance(item, kind.contribution):
            raise PluginError(f"{kind.hook} offers {_short(item)}, expected a {kind.contribution.__name__}")
        require_same_contract(item)
    return offered


def _items(result: Any) -> list[Any]:
    return [result] if isinstance(result, Contribution) else list(islice(result, MAX_OFFERED + 1))


def _short(item: object) -> str:
    return f"the {item.kind} {item.name!r}" if isinstance(item, Contribution) else f"{item!r:.60}"
