"""Lazy attribute import for packages (PEP 562)."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


def imported_on_use(
    package: str, names: "Sequence[str]", modules: "Sequence[str]"
) -> "tuple[Callable[[str], object], Callable[[], list[str]]]":
    """Return the `__getattr__` and `__dir__` of a package that imports names when they are first used.

    Args:
        package: the name of the package.
        names: its public names, for `dir`.
        modules: its modules that define names, searched in this order: light ones first.
    """

    def attribute(name: str) -> object:
        if name in names:
            for home in modules:
                module = import_module(f"{package}.{home}")
                if hasattr(module, name):
                    return getattr(module, name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return attribute, lambda: list(names)
