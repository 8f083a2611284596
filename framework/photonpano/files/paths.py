"""Paths and URLs that users give: what cannot be one, and what must not be opened."""

from __future__ import annotations

import re
import stat
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import urlsplit

_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)

# A scheme has two letters or more: `C:/` is a disk. `Path` makes one slash of two.
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+(.+)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Url:
    """A file or folder on a server or in an object store, such as `s3://bucket/cube.npy`.

    As text, which messages and records contain, it has neither the user and password nor the query of `address`.
    """

    address: str = field(repr=False)  # the whole URL, with its secrets

    @property
    def scheme(self) -> str:
        """The part before the colon, in small letters, such as "s3"."""
        return self.address.partition(":")[0].lower()

    @property
    def name(self) -> str:
        """The last part of the path; empty if there is none."""
        return self._path.name

    @property
    def stem(self) -> str:
        """The name without its last suffix."""
        return self._path.stem

    @property
    def suffix(self) -> str:
        """The last suffix of the name, such as ".npy"."""
        return self._path.suffix

    @property
    def _path(self) -> PurePosixPath:
        return PurePosixPath(str(self).partition("://")[2].partition("/")[2])

    def __truediv__(self, name: str) -> Url:
        whole, mark, query = self.address.partition("?") if self._has_query else (self.address, "", "")
        return Url(f"{whole.rstrip('/')}/{name}{mark}{query}")

    def __str__(self) -> str:
        scheme, _, rest = self.address.partition("://")
        host, slash, path = rest.partition("/")
        shown = f"{scheme}://{host.rpartition('@')[2]}{slash}{path}"
        return shown.partition("?")[0].partition("#")[0] if self._has_query else shown

    @property
    def _has_query(self) -> bool:
        return self.scheme in ("http", "https")

    @property
    def host(self) -> str:
        """The server or the bucket."""
        return urlsplit(str(self)).netloc


Location = Path | Url  # where a capture is: a path, or a URL


def location(text: str | Path | Url) -> Location:
    """Return a URL for text that begins with a scheme, such as `s3://`, and a path for any other."""
    if isinstance(text, Url):
        return text
    found = _URL.fullmatch(str(text))
    return Path(text) if found is None else Url(f"{found[1]}://{found[2]}")


def as_written(place: Location) -> str:
    """Return a path or URL as a spec names it: a URL with its secrets."""
    return place.address if isinstance(place, Url) else str(place)


def given_path(path: Path) -> Path:
    """Return a path that a user has written, with its home folder filled in; a `ValueError` if that is of nobody."""
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise ValueError(f"{path} begins with the home folder of an unknown user; write the whole path") from error


def refusal(path: Path) -> str | None:
    """Return why a path must not be opened, None for a regular file, a folder, and nothing at all.

    Reading a named pipe or a device may wait for ever, or never end. Nothing is opened to find out.
    """
    try:
        mode = path.stat().st_mode
    except OSError:  # whoever opens it says more
        return None
    except ValueError:
        return f"{str(path)!r} contains the character NUL, which no path can; correct the path"
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return None
    kind = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
    return f"{path} is {kind}, not a regular file; copy what it holds to a file, and name that"
