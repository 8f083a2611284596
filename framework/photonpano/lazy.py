"""Packages whose names are imported when they are first used: what only lists plugins needs no heavy library."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


def imported_on_use(package: str, names: "Sequence[str]", modules: "Sequence[str]") -> "Callable[[str], object]":
    """Return what a package calls `__getattr__`.

    Args:
        package: its name.
        names: what it offers, its `__all__`.
        modules: those of its modules that define the names, light ones first: they are asked in this order.
    """

    def attribute(name: str) -> object:
        if name in names:
            for home in modules:
                module = import_module(f"{package}.{home}")
                if hasattr(module, name):
                    return getattr(module, name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return attribute
