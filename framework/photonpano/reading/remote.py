"""Files on servers and in object stores, read in ranges through fsspec."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from types import ModuleType
from typing import Any, NamedTuple

from photonpano.errors import InputError, PhotonpanoError
from photonpano.files.paths import Url
from photonpano.text import install_line

# The library that fsspec needs for each scheme, and what installs both.
LIBRARIES = {
    "s3": ("s3fs", "photonpano[s3]"),
    "s3a": ("s3fs", "photonpano[s3]"),
    "gs": ("gcsfs", "gcsfs"),
    "gcs": ("gcsfs", "gcsfs"),
    "http": ("aiohttp", "photonpano[http]"),
    "https": ("aiohttp", "photonpano[http]"),
}
# Errors of the libraries by the names of their classes, since none of the libraries need be installed.
_NO_RIGHTS = {"PermissionError", "NoCredentialsError", "PartialCredentialsError", "RefreshError", "DefaultCredentialsError"}
_NO_ANSWER = {
    *("ClientConnectionError", "EndpointConnectionError", "ConnectTimeoutError", "ReadTimeoutError"),
    *("ConnectionError", "TimeoutError", "FSTimeoutError", "HTTPClientError", "gaierror"),
}


class RemoteFile(NamedTuple):
    """What a server says about a file."""

    size: int | None  # its bytes; None if the server does not say
    modified: datetime | None  # when it was written; None if the server does not say
    etag: str | None  # the server's mark of its content; None if there is none


def library(module: str, install: str, what: str) -> ModuleType:
    """Import a library that only some files need; `install` goes to pip, `what` is the subject of the message.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(f"{what} needs {module}, which is not installed: {install_line([install])}") from error


def remote_file(url: Url) -> RemoteFile:
    """Ask for the size and the age of a file.

    Raises:
        InputError: there is no such file, it may not be read, no server answers, or a library is not installed.
    """
    with _asking(url):
        system, path = _file_system(url)
        system.invalidate_cache()
        found = system.info(path)
        if found.get("type") == "directory":
            raise InputError(f"{url} is a folder; name the file in it")
        etag = found.get("ETag") or found.get("etag")
        modified = _time(found.get("LastModified") or found.get("updated") or found.get("mtime") or found.get("Last-Modified"))
        return RemoteFile(found.get("size"), modified, etag and str(etag).strip('"'))


def size_of(url: Url) -> int:
    """Return the size of a file in bytes, if it can be read in ranges; raises as `remote_file`."""
    size = remote_file(url).size
    if size is None:
        raise InputError(f"{url} is of unknown size: its server does not give it; download the file")
    if size > 1 and url.scheme in ("http", "https"):
        with _asking(url):
            system, path = _file_system(url)
            try:
                with system.open(path, "rb", cache_type="none") as file:
                    file.seek(1)
                    file.read(1)
            except ValueError:  # fsspec refuses to read a whole file for one byte of it
                raise _without_ranges(url) from None
    return size


def read_range(url: Url, start: int, stop: int) -> bytes:
    """Read the bytes of a file from `start` to `stop` - 1, fewer if it ends before; raises as `remote_file`."""
    with _asking(url):
        system, path = _file_system(url)
        data: bytes = system.cat_file(path, start=start, end=stop)
    if len(data) > stop - start:
        raise _without_ranges(url)
    return data


def remote_files_in(url: Url, suffix: str) -> list[Url]:
    """Return the files below a URL with an ending, in no order; the URL itself if it has it; raises as `remote_file`."""
    if url.suffix.lower() == suffix:
        return [url]
    with _asking(url):
        system, path = _file_system(url)
        if url.scheme in ("http", "https"):
            raise InputError(f"{url} is no {suffix} file, and files are not listed over {url.scheme}; name the file itself")
        system.invalidate_cache()
        root = system._strip_protocol(path).rstrip("/")
        names = [found.removeprefix(root).lstrip("/") for found in system.find(path)]
    shown = (name for name in names if name.lower().endswith(suffix) and not name.rpartition("/")[2].startswith("."))
    return [url / name for name in shown]


def _file_system(url: Url) -> tuple[Any, str]:
    """Return the file system of fsspec for a URL, which is kept for the next call, and the path in it."""
    module, install = LIBRARIES.get(url.scheme, ("fsspec", "photonpano[http]"))
    library(module, install, str(url))
    fsspec = library("fsspec", install, str(url))
    if url.scheme not in fsspec.available_protocols():
        known = "s3://, gs://, http:// and https://"
        raise InputError(f"{url} has a scheme that nothing reads; captures are read from paths, and from {known}")
    try:
        system, path = fsspec.core.url_to_fs(url.address)
    except ImportError as error:
        raise InputError(f"{url} needs a library that is not installed: {error}") from error
    return system, path


@contextmanager
def _asking(url: Url) -> Iterator[None]:
    """Turn what the libraries raise into an `InputError`. Their own words may contain secrets of the URL."""
    try:
        yield
    except PhotonpanoError:
        raise
    except Exception as error:
        raise InputError(_message(url, error)) from None


def _message(url: Url, error: Exception) -> str:
    if isinstance(error, FileNotFoundError) and url.scheme.startswith("http") and isinstance(error.__cause__, Exception):
        error = error.__cause__  # over HTTP, fsspec calls any failure so
    names, status = {each.__name__ for each in type(error).__mro__}, getattr(error, "status", None)
    if isinstance(error, FileNotFoundError) or status == 404:
        return f"there is no {url}; check the server or bucket, and the path"
    if names & _NO_RIGHTS or status in (401, 403):
        return (
            f"{url} may not be read: its server refuses access{f' ({status})' if status else ''}; give credentials in the "
            "environment, and for public files of an object store none"
        )
    if names & _NO_ANSWER:
        return f"cannot read {url}: no server answers at {url.host or url.scheme}; check the address and the network"
    if isinstance(error, MemoryError):
        return f"{url} needs more memory than there is"
    return f"cannot read {url}: {status or type(error).__name__}; check the address, or download the file"


def _without_ranges(url: Url) -> InputError:
    return InputError(f"{url} cannot be read in parts: its server sends whole files only; download the file")


def _time(value: Any) -> datetime | None:
    if isinstance(value, str):
        try:
            value = parsedate_to_datetime(value)
        except ValueError:
            try:
                value = datetime.fromisoformat(value)
            except ValueError:
                return None
    if isinstance(value, int | float):
        value = datetime.fromtimestamp(value, UTC)
    return value.astimezone(UTC) if isinstance(value, datetime) else None
