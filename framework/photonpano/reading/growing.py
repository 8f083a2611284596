"""Files that are still being written."""

from __future__ import annotations

import math

from photonpano.errors import InputError
from photonpano.paths import Location, Url
from photonpano.reading.files import size_of
from photonpano.reading.gzipped import is_gzip
from photonpano.reading.npy import npy_header

_SHORTEST_HEADER = 128  # bytes of the shortest header that numpy writes


def arrived_frames(path: Location) -> int | None:
    """Return how many whole frames of a .npy file are there that is still being written: None if not even its header is.

    Raises:
        InputError: the file cannot be read, is something else, or cannot be read before it is whole.
    """
    if isinstance(path, Url):
        raise InputError(f"{path} is a URL, which cannot be followed: follow a file, or a pipe")
    if is_gzip(path):
        raise InputError(f"{path} is compressed, so that no frame can be read before all are there; follow a .npy file")
    if not path.exists() or size_of(path) < _SHORTEST_HEADER:
        return None
    header = npy_header(path)
    n_frames, *of_frame = header.shape
    frame_bytes = math.prod(of_frame) * header.dtype.itemsize
    return min(n_frames, (size_of(path) - header.offset) // frame_bytes) if frame_bytes else 0
