"""Pack values for another process: everything by value, but for the capture, which is opened there."""

from __future__ import annotations

import io
import pickle
from typing import Any

from photonpano.errors import PluginError

_CAPTURE = "capture"


def packed(value: object, capture: object) -> bytes:
    """Pickle a value, in which the capture travels as a name; a `PluginError` says what cannot be pickled."""
    buffer = io.BytesIO()
    try:
        _Packer(buffer, capture).dump(value)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise PluginError(
            f"a component cannot be sent to other processes: {error}; run it in threads: leave out run.executor"
        ) from error
    return buffer.getvalue()


def unpacked(data: bytes, capture: object) -> Any:
    """Return a value from what `packed` returned; `capture` takes the place of the capture."""
    return _Unpacker(io.BytesIO(data), capture).load()


class _Packer(pickle.Pickler):
    def __init__(self, buffer: io.BytesIO, capture: object) -> None:
        super().__init__(buffer, protocol=pickle.HIGHEST_PROTOCOL)
        self._capture = capture

    def persistent_id(self, obj: object) -> str | None:
        return _CAPTURE if obj is self._capture else None


class _Unpacker(pickle.Unpickler):
    def __init__(self, buffer: io.BytesIO, capture: object) -> None:
        super().__init__(buffer)
        self._capture = capture

    def persistent_load(self, pid: object) -> object:
        if pid != _CAPTURE:
            raise pickle.UnpicklingError(f"unknown object {pid!r}")
        return self._capture
