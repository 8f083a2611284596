"""Turn results into named arrays and back, without pickle: numbers, texts, arrays, and the dataclasses that hold them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.motion.diagnosis import Contrast
from photonpano.motion.registration import Registered
from photonpano.motion.tracking import Place, StartingMotion
from photonpano.residuals.halves import Agreements, Halves
from photonpano.residuals.measure import Residuals
from photonpano.residuals.shaking import Shaking
from photonpano.values import Decision, Edge, FrameSpan, Located, NotLocated, Panorama, Patches, Refined

Arrays = Mapping[str, NDArray[np.generic]]
_KINDS = (
    Agreements, Contrast, Decision, Edge, FrameSpan, Halves, Located, NotLocated, Panorama, Patches, Place, Refined, Registered,
    Residuals, Shaking, StartingMotion,
)  # fmt: skip
# The dataclasses that can be read back.
_BY_NAME: dict[str, Any] = {kind.__name__: kind for kind in _KINDS}
_TREE = "tree"
_SMALL = 4096  # arrays of fewer values are joined: an archive of thousands of arrays is slow
_ARRAY, _MAPPING, _DATACLASS = "array", "mapping", "dataclass"


def packed(value: Any) -> dict[str, NDArray[np.generic]]:
    """Return named arrays that hold a value; floats stay the same to the last bit. `TypeError` for what cannot be kept."""
    packer = _Packer()
    tree = json.dumps(packer.tree(value), separators=(",", ":"))
    joined = {name: np.concatenate(parts) for name, parts in packer.small.items()}
    return {_TREE: np.frombuffer(tree.encode(), np.uint8), **joined, **packer.large}


def unpacked(arrays: Arrays) -> Any:
    """Return the value that `packed` has made arrays of; lists come back as tuples. Damaged arrays raise any exception."""
    return _unpacked(json.loads(bytes(arrays[_TREE]).decode()), arrays)


def digest(*values: Any) -> str:
    """Return a hash of values: 32 hexadecimal digits."""
    found = hashlib.blake2b(digest_size=16)
    for name, array in packed(values).items():
        found.update(f"{name} {array.dtype.str} {array.shape}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


class _Packer:
    """Collects the arrays of a value: `small` are parts to join, by the name of their type, `large` arrays by their names."""

    def __init__(self) -> None:
        self.small: dict[str, list[NDArray[np.generic]]] = {}
        self.large: dict[str, NDArray[np.generic]] = {}
        self._sizes: dict[str, int] = {}

    def tree(self, value: Any) -> Any:
        """Return a value as JSON, with references in place of arrays."""
        if value is None or isinstance(value, bool | str):
            return value
        if isinstance(value, np.ndarray):
            return {_ARRAY: self._reference(value)}
        if isinstance(value, np.generic):
            return self.tree(value.item())
        if isinstance(value, Real):
            return int(value) if isinstance(value, Integral) else float(value)
        if isinstance(value, Mapping):
            return {_MAPPING: [[self.tree(key), self.tree(item)] for key, item in value.items()]}
        if isinstance(value, Sequence):
            return [self.tree(item) for item in value]
        if is_dataclass(value) and not isinstance(value, type):
            return {
                _DATACLASS: type(value).__name__,
                **{each.name: self.tree(getattr(value, each.name)) for each in fields(value)},
            }
        raise TypeError(f"{type(value).__name__} cannot be kept")

    def _reference(self, array: NDArray[np.generic]) -> list[Any]:
        """Store an array; return its name, place and shape."""
        if array.dtype.kind not in "biuf" or not array.dtype.isnative:
            raise TypeError(f"an array of {array.dtype} cannot be kept")
        if array.size >= _SMALL:
            name = f"large-{len(self.large)}"
            self.large[name] = array
            return [name, 0, list(array.shape)]
        name = array.dtype.name
        start = self._sizes.get(name, 0)
        self.small.setdefault(name, []).append(array.ravel())
        self._sizes[name] = start + array.size
        return [name, start, list(array.shape)]


def _unpacked(tree: Any, arrays: Arrays) -> Any:
    if isinstance(tree, list):
        return tuple(_unpacked(item, arrays) for item in tree)
    if not isinstance(tree, dict):
        return tree
    if _ARRAY in tree:
        name, start, shape = tree[_ARRAY]
        size = int(np.prod(shape, dtype=int))
        part = arrays[name].ravel()[start : start + size].reshape(shape)
        return part if part.size == arrays[name].size else part.copy()
    if _MAPPING in tree:
        return {_unpacked(key, arrays): _unpacked(item, arrays) for key, item in tree[_MAPPING]}
    kind = _BY_NAME[tree[_DATACLASS]]
    return kind(**{each.name: _unpacked(tree[each.name], arrays) for each in fields(kind)})
