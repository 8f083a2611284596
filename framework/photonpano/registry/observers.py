"""Plugins that watch runs, and where they come from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from photonpano.registry.plugins import OBSERVATION_HOOKS

if TYPE_CHECKING:
    import pluggy


@dataclass(frozen=True, slots=True)
class Observer:
    """A plugin with observation hooks.

    Attributes:
        plugin: its distribution.
        version: the version of that distribution.
        entry_point: how the distribution names the plugin, such as "progress = my_progress.hooks".
        hook: calls its hooks by their names; one that the plugin does not have does nothing.
    """

    plugin: str
    version: str
    entry_point: str
    hook: pluggy.HookRelay

    @property
    def origin(self) -> str:
        """Distribution, version and entry point, for messages."""
        return f"{self.plugin} {self.version} ({self.entry_point})"

    @property
    def watches(self) -> tuple[str, ...]:
        """The observation hooks that it has."""
        return tuple(name for name in OBSERVATION_HOOKS if getattr(self.hook, name).get_hookimpls())
