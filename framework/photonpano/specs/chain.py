"""Spell out a chain of locators: the first of them, with the others as its fallbacks."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from photonpano.registry.chain import CHAIN, ChainConfig
from photonpano.specs.tree import Value, joined
from photonpano.specs.validation import validate

if TYPE_CHECKING:
    from pathlib import Path

    from photonpano.errors import Problem

NO_PART = f"{CHAIN.name!r} is no part of a chain and no fallback; list the locators themselves"
"""What is wrong where the name stands among locators that are tried one after the other."""


def spelled_out(section: Value, keys: Value, directory: Path, problems: list[Problem]) -> tuple[Value, Value] | None:
    """Write a section that uses the chain as one that uses its first locator, and has the others as fallbacks.

    Args:
        section: a mapping whose `use` names the chain.
        keys: what is written under its `with`.
        directory: what relative paths count from.
        problems: what is wrong is added here.

    Returns:
        The section, every value of it with the place where it was written, and the first locator as it was written; None if
        there is no such list.
    """
    content = section.content
    assert isinstance(content, dict)
    if fallback := content.get("fallback"):
        problems.append(fallback.head.problem("a chain has its fallbacks among its backends"))
    validate(ChainConfig, keys, directory, problems)
    written = keys.content.get("backends") if isinstance(keys.content, dict) else None
    if written is None:
        defaults: tuple[str, ...] = ChainConfig.model_fields["backends"].default
        use = content["use"]
        written = Value([Value(name, use.place, use.key) for name in defaults], use.place)
    items = written.content
    if not isinstance(items, list) or not items or not all(isinstance(item.content, str | dict) for item in items):
        return None
    first, *others = items
    chosen = dict(first.content) if isinstance(first.content, dict) else {"use": first}
    if nested := chosen.pop("fallback", None):
        message = "a locator of a chain has no fallback; list all of them, in the order in which they are tried"
        problems.append(nested.head.problem(message))
    nothing = replace(first.head, where=joined(first.place.where, "use"))
    if chosen.setdefault("use", Value(None, nothing)).content == CHAIN.name:
        problems.append(chosen["use"].head.problem(NO_PART))
        return None
    place = replace(written.place, where=joined(section.place.where, "fallback"))
    return Value(chosen | {"fallback": Value(others, place)}, first.place, first.key), first
