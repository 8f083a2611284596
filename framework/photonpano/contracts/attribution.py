"""Name the plugin of a component in its errors, and check what its methods return."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar, cast

from photonpano.contracts.requirements import REQUIRED, BrokenContract
from photonpano.errors import PhotonpanoError, PluginError, described

T = TypeVar("T")
_MAKERS = ("fit", "fit_turns", "turning")  # methods that return another component


@contextmanager
def attributing(label: str, where: str) -> Iterator[None]:
    """Raise a `PluginError` that names a component for errors of the block. Errors that are written for users pass unchanged.

    The `label` says who provides it, such as "merger 'photon-mle' of photonpano 0.1.0", `where` what it works on, such as
    "level 2" or "frames 0 to 15".
    """
    try:
        yield
    except PhotonpanoError:
        raise
    except BrokenContract as error:
        raise PluginError(f"{label} broke its contract at {where}: {error}") from None
    except Exception as error:
        raise PluginError(f"{label} failed at {where}: {described(error)}") from error


class Attributed:
    """A component whose errors name it, and whose answers are checked by `REQUIRED`.

    It has the methods that the component has: ask with `hasattr` for optional ones. What its methods make, such as the
    trajectory of an interpolator, is attributed to the same plugin.
    """

    def __init__(self, component: Any, label: str, where: str) -> None:
        self.component, self.label, self.where = component, label, where

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)  # pickle asks for these before there is a component
        member = getattr(self.component, name)
        return partial(self._called, member, name) if callable(member) else member

    def __call__(self, *given: Any) -> Any:
        """Call what is attributed, such as the function that `fit_turns` returns."""
        return self._called(self.component, "__call__", *given)

    def _called(self, method: Callable[..., Any], name: str, *given: Any) -> Any:
        with attributing(self.label, self.where):
            found = method(*given)
            if require := REQUIRED.get(name):
                found = require(found, *given)
        return Attributed(found, self.label, self.where) if name in _MAKERS else found


def attributed(component: T, label: str, where: str) -> T:
    """Return a component as `Attributed`; for the arguments, see `attributing`."""
    return cast("T", Attributed(component, label, where))


def label_of(component: object) -> str:
    """Return who provides a component."""
    return component.label if isinstance(component, Attributed) else f"a {type(component).__name__}"


@contextmanager
def blaming(component: object) -> Iterator[None]:
    """Name a component for a broken contract that the block finds in what it returned before."""
    with attributing(label_of(component), component.where if isinstance(component, Attributed) else "work"):
        yield
