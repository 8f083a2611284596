"""Collect what one plugin offers, apart from all others."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pluggy

from photonpano import hookspecs
from photonpano.contributions import Contribution
from photonpano.errors import PluginError
from photonpano.registry.kinds import KINDS, Kind
from photonpano.registry.suggestions import listed

if TYPE_CHECKING:
    from photonpano.contributions import AnyContribution

PREFIX = f"{hookspecs.PROJECT}_"


def contributions_of(plugin: object) -> tuple[AnyContribution, ...]:
    """Call the five hooks of one plugin and check what they return.

    The plugin has a plugin manager of its own, so that nothing it does wrong touches another.

    Args:
        plugin: a module, or any object, with hooks.

    Raises:
        PluginError: a hook is unknown, lacks its mark, takes arguments, raises, or offers something of another kind.
    """
    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    _check_names(plugin, manager)
    try:
        manager.register(plugin)
        manager.check_pending()
    except pluggy.PluginValidationError as error:
        raise PluginError(" ".join(str(error).split())) from error
    return tuple(contribution for kind in KINDS.values() for contribution in _offered(manager, kind))


def _check_names(plugin: object, manager: pluggy.PluginManager) -> None:
    """Refuse functions that look like hooks and are none: pluggy would pass over them in silence."""
    hooks = [kind.hook for kind in KINDS.values()]
    for name in dir(plugin):
        if not name.startswith(PREFIX) or not callable(getattr(plugin, name)):
            continue
        if name not in hooks:
            raise PluginError(f"there is no hook {name!r}; known: {listed(hooks)}")
        if manager.parse_hookimpl_opts(plugin, name) is None:
            raise PluginError(f"{name} is not marked with @photonpano.hookimpl")


def _offered(manager: pluggy.PluginManager, kind: Kind) -> list[AnyContribution]:
    try:
        results: list[Any] = getattr(manager.hook, kind.hook)()
        offered = [item for result in results for item in _items(result)]
    except Exception as error:
        raise PluginError(f"{kind.hook} raised {type(error).__name__}: {error}") from error
    for item in offered:
        if not isinstance(item, kind.contribution):
            raise PluginError(f"{kind.hook} offers {_short(item)}, expected a {kind.contribution.__name__}")
    return offered


def _items(result: Any) -> list[Any]:
    return [result] if isinstance(result, Contribution) else list(result)


def _short(item: object) -> str:
    return f"the {item.kind} {item.name!r}" if isinstance(item, Contribution) else f"{item!r:.60}"
