"""Choose the channel of a capture that is recognised by itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from photonpano.errors import InputError

Capture = TypeVar("Capture")

_MIDDLE = 1


class Channel(NamedTuple):
    """The channel that a recognised capture is read with.

    Attributes:
        keys: the key `channel` of the source, if the capture has channels.
        clause: follows the reason why the capture was recognised.
    """

    keys: dict[str, int]
    clause: str


def with_channel(read: Callable[[int | None], Capture]) -> tuple[Capture, Channel] | None:
    """Read a capture without channels, or the middle one of three.

    Args:
        read: reads the capture with a `channel`, and raises an `InputError` if the capture does not have it.

    Returns:
        What `read` returned, and the channel; None if it raised for both.
    """
    for channel in (None, _MIDDLE):
        try:
            found = read(channel)
        except InputError:
            continue
        if channel is None:
            return found, Channel({}, "")
        return found, Channel({"channel": channel}, ", of whose channels the middle one is used")
    return None
