"""What is wrong with a capture, for the `check` of a source."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec

from photonpano.errors import InputError

P = ParamSpec("P")


def objections(read: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> tuple[str, ...]:
    """Try what can be read of a capture at little cost, and return what is refused: a sentence, or nothing."""
    try:
        read(*args, **kwargs)
    except InputError as error:
        return (str(error),)
    return ()
