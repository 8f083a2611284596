"""A folder of named records: each is a file that is written whole, and is checked when it is read."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from photonpano.atomic import atomic_path
from photonpano.errors import OutputError
from photonpano.pipeline.checkpoints.records import packed, unpacked
from photonpano.text import byte_size

logger = logging.getLogger(__name__)

SUFFIX = ".npz"
_SPARE = 8  # free space that a record needs, in multiples of its own size: results come first


class Store:
    """Named records in a folder that exists. One that cannot be written, or is damaged, is a warning and computed again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.holds_something = any(folder.glob(f"[!.]*{SUFFIX}"))
        self._warned = False

    def save(self, name: str, value: Any) -> bool:
        """Write a record; return whether it was possible."""
        path = self.folder / f"{name}{SUFFIX}"
        try:
            arrays = packed(value)
            self._require_room(sum(array.nbytes for array in arrays.values()))
            # A record that a power failure damages is computed again; waiting for the disk would cost more.
            with atomic_path(path, flushed=False) as temporary:
                np.savez(temporary, allow_pickle=False, **arrays)
        except (OutputError, OSError, TypeError) as error:
            if not self._warned:
                logger.warning("%s; the run goes on, but if it is interrupted, this is computed again", error)
            self._warned = True
            return False
        self.holds_something = True
        return True

    def load(self, name: str) -> Any:
        """Read a record; None if there is none, or it is damaged."""
        path = self.folder / f"{name}{SUFFIX}"
        if not path.exists():
            return None
        try:
            # Each array has a checksum, which is compared when it is read.
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
                return unpacked(dict(archive))
        except Exception as error:  # zipfile, zlib, numpy and json raise what they like for a damaged file
            logger.warning(
                "%s is damaged (%s), and is computed again", path, " ".join(str(error).split()) or type(error).__name__
            )
            path.unlink(missing_ok=True)
            return None

    def names(self, start: str) -> list[str]:
        """Return the names of the records that begin with a text, in order."""
        return sorted(path.name.removesuffix(SUFFIX) for path in self.folder.glob(f"{start}*{SUFFIX}"))

    def _require_room(self, n_bytes: int) -> None:
        free = shutil.disk_usage(self.folder).free
        if free < (1 + _SPARE) * n_bytes:
            raise OutputError(f"{self.folder}: what was found is not kept, as the {byte_size(free)} free are for the results")
