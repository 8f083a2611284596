"""The kinds of components, a row for each, and the marks of hooks."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from typing import Any, get_args, get_type_hints

import pluggy

PROJECT = "photonpano"  # the project name of pluggy, and the entry-point group
hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of component. Hooks, the reader of specs, the JSON Schema and the conformance kit go by this row."""

    name: str  # what a component of this kind is, such as `locator`
    section: str  # where a spec chooses it, such as `locate` or `output.formats`
    # the record that the hook yields; what its `build` returns is the interface of the component
    contribution: type[Any] = field(repr=False)
    default: str | None = None  # the component that a spec uses if it names none
    of_level: bool = False  # whether each level of a run has one
    several: bool = False  # whether the section is a list of components
    meaning: str = ""  # what the section chooses, for editors; empty if its keys say so

    @property
    def hook(self) -> str:
        """The hook that offers it, such as `photonpano_locators`."""
        return f"{PROJECT}_{self.name.replace('-', '_')}s"

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods of the component."""
        interface = get_args(get_type_hints(self.contribution)["build"])[-1]
        return tuple(name for name, member in vars(interface).items() if inspect.isfunction(member) and name[0] != "_")


KINDS: dict[str, Kind] = {}
"""All kinds by name, in the order in which a run needs them; each contribution class adds its own."""
