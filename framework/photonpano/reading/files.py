"""Files on servers and in object stores, read in ranges through fsspec."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from functools import lru_cache
from pathlib import Path, PurePath, PurePosixPath
from types import ModuleType
from typing import Any, NamedTuple, ParamSpec, TypeVar, overload

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from photonpano.errors import InputError, PhotonpanoError
from photonpano.files.paths import Location, Url, refusal
from photonpano.files.paths import as_written as as_written
from photonpano.text import install_line
from photonpano.values import Bayer

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
Model = TypeVar("Model", bound=BaseModel)
P = ParamSpec("P")

_MOST_OPEN = 16  # files kept open: a capture may have hundreds, and a process may often open 1024
_TEXT_AND_NUMBER = re.compile("([^0-9]*)([0-9]*)")


class RemoteFile(NamedTuple):
    """What a server says about a file."""

    size: int | None  # its bytes; None if the server does not say
    modified: datetime | None  # when it was written; None if the server does not say
    etag: str | None  # the server's mark of its content; None if there is none


def library(module: str, install: str, what: str) -> ModuleType:
    """Import a library that only some files need; an `InputError` if it is not installed.

    `install` goes to pip, `what` is the subject of the message.
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


def remote_size(url: Url) -> int:
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


def missing_file(path: Path, kind: str = "file") -> str:
    """Return the message that there is no such file, or no such "file or folder"."""
    return f"there is no {kind} {path}; check the path"


@contextmanager
def reading(path: Path, otherwise: str | None = None) -> Iterator[None]:
    """Refuse what is no regular file before it is opened, and turn what reading raises into an `InputError`.

    Args:
        path: the file.
        otherwise: follows the path in the message for errors that do not come from the system, such as "is not a MATLAB file".
            Parsers raise nearly anything for a damaged file. By default such errors pass.

    Example:
        ```python
        with reading(path, "is not a picture; save it as PNG"):
            return decode(path.read_bytes())
        ```
    """
    if reason := refusal(path):
        raise InputError(reason)
    with _errors_in_words(path, otherwise):
        yield


@contextmanager
def _errors_in_words(path: Path, otherwise: str | None = None) -> Iterator[None]:
    """Turn what reading raises into an `InputError`: see `reading`."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(missing_file(path)) from error
    except MemoryError as error:
        raise InputError(f"{path} needs more memory than there is: it is too large, or damaged") from error
    except PhotonpanoError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise InputError(f"cannot read {path}: {error.strerror}") from error
        if otherwise is None:
            raise
        raise InputError(f"{path} {otherwise}") from error


def objections(read: Callable[P, object], *args: P.args, **kwargs: P.kwargs) -> tuple[str, ...]:
    """Call a function for the `check` of a source, and return the message of the `InputError` that it raises, if any."""
    try:
        read(*args, **kwargs)
    except InputError as error:
        return (str(error),)
    return ()


def require_readable(path: Path) -> None:
    """Raise an `InputError` for a file that may not be opened or is no regular file, or a folder that may not be listed."""
    with reading(path):
        if path.is_dir():
            next(path.iterdir(), None)
        else:
            os.close(os.open(path, os.O_RDONLY))


def size_of(path: Location) -> int:
    """Return the size of a file in bytes; an `InputError` if it is missing, or cannot be read in parts."""
    if isinstance(path, Url):
        return remote_size(path)
    with reading(path):
        return path.stat().st_size


def require_there(path: Location) -> None:
    """Raise an `InputError` for a path that is missing, or may not be opened. Nothing is asked of a URL: its reader does."""
    if isinstance(path, Url):
        return
    if not path.exists():
        raise InputError(missing_file(path, "file or folder"))
    require_readable(path)


@overload
def files_in(path: Path, suffix: str) -> list[Path]: ...


@overload
def files_in(path: Location, suffix: str) -> list[Location]: ...


def files_in(path: Location, suffix: str) -> Sequence[Location]:
    """Return the files of a capture: the file itself, or those of a folder, nested ones too, in natural order (0, 2, 10).

    Hidden files are left out.

    Args:
        path: a file, whatever its name, or a folder.
        suffix: how the names of files in a folder end, such as ".bin"; capital letters do as well.

    Raises:
        InputError: there is no such file or folder, or no such file in the folder.
    """
    if isinstance(path, Url):
        urls = remote_files_in(path, suffix)
        if not urls:
            raise InputError(f"there is no {suffix} file below {path}; check the address")
        return sorted(urls, key=lambda url: natural_order(PurePosixPath(str(url))))
    with reading(path):
        if path.is_file():
            return [path]
        if not path.is_dir():
            raise InputError(missing_file(path, "file or folder"))
    require_readable(path)
    found = [
        file.relative_to(path)
        for file in path.rglob("*")
        if file.suffix.lower() == suffix and not file.name.startswith(".") and file.is_file()
    ]
    if not found:
        raise InputError(f"there is no {suffix} file in the folder {path}; check the path")
    return [path / file for file in sorted(found, key=natural_order)]


def natural_order(path: PurePath) -> list[tuple[list[tuple[str, int]], str]]:
    """Return a key that sorts paths with their numbers as numbers, so that 10 comes after 2."""
    return [([(text, int(digits or 0)) for text, digits in _TEXT_AND_NUMBER.findall(part)], part) for part in path.parts]


def read_json(path: Path, model: type[Model]) -> Model:
    """Read a JSON file as a pydantic model; an `InputError` if it is missing, or does not fit the model."""
    with reading(path):
        content = path.read_bytes()
    try:
        return model.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{path} is wrong{where and f' at {where}'}: {first['msg']}; write it again") from error


def read_start(path: Location, n_bytes: int) -> bytes:
    """Return the first bytes of a file; none if it cannot be read, or is no regular file."""
    if isinstance(path, Url):
        try:
            return read_range(path, 0, n_bytes)
        except InputError:
            return b""
    if refusal(path):
        return b""
    try:
        with path.open("rb") as file:
            return file.read(n_bytes)
    except OSError:
        return b""


class OpenFiles:
    """Reads pieces of files from any thread. A file is opened when it is first read, and at most 16 stay open."""

    def __init__(self) -> None:
        self._opened = lru_cache(_MOST_OPEN)(_OpenFile)

    def read(self, path: Location, position: int, target: NDArray[np.uint8]) -> None:
        """Fill a contiguous array with the bytes of a file from a position on.

        Raises an `InputError` if the file cannot be read, or has become shorter.
        """
        if isinstance(path, Url):
            data = read_range(path, position, position + target.nbytes)
            if len(data) != target.nbytes:
                raise InputError(f"{path} is shorter than it should be; copy or record it again")
            target.reshape(-1)[:] = np.frombuffer(data, np.uint8)
            return
        with _errors_in_words(path):
            file = self._opened(path)
            left = target.reshape(-1).data
            while left:
                done = os.preadv(file.descriptor, [left], position)
                if not done:
                    raise InputError(f"{path} has become shorter while it was read; copy or record it again")
                left, position = left[done:], position + done

    def close(self) -> None:
        """Close the files."""
        self._opened.cache_clear()


class _OpenFile:
    """A file that is closed when neither the cache nor a thread that reads it refers to it."""

    def __init__(self, path: Path) -> None:
        if reason := refusal(path):  # asked here, not before each of many small pieces
            raise InputError(reason)
        self.descriptor = os.open(path, os.O_RDONLY)

    def __del__(self) -> None:
        # At the end of the program, modules go before the last files do.
        if hasattr(self, "descriptor") and os is not None:
            os.close(self.descriptor)


COLOURS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "clear": (255, 255, 255)}
_LETTERS = "rgb"
_WHAT = "the pattern of a colour filter"


def read_arrays(path: Path, expected: str, names: Container[str] | None = None) -> dict[str, NDArray[Any]]:
    """Read the arrays of an .npz archive by their names, or the array of a .npy file under the name "".

    Args:
        path: the file.
        expected: what it should be, for the message, such as "a file of dark counts".
        names: of an archive, only arrays of these names are read; by default all.

    Raises:
        InputError: the file is missing, is damaged, or holds something else.
    """
    with reading(path, f"is not {expected}: it is no .npy or .npz file of plain numbers"), path.open("rb") as file:
        content = np.load(file, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return {"": content}
        arrays = {}
        with content:
            for name in content.files:
                if names is None or name in names:
                    with reading(path, f"is damaged: {name} cannot be read as an array of plain numbers; write it again"):
                        arrays[name] = np.asarray(content[name])
        return arrays


def read_array(path: Path, expected: str, name: str = "") -> NDArray[Any]:
    """Read the array of a .npy file or, where `name` is given, this array of an .npz archive.

    Raises:
        InputError: see `read_arrays`; or the file is an archive without such an array.
    """
    arrays = read_arrays(path, expected, (name,))
    if not arrays:
        raise InputError(f"{path} is an archive" + (f" without an array {name!r}" if name else "; name a .npy file"))
    (array,) = arrays.values()
    return array


def read_picture(path: Path, otherwise: str, flags: int) -> NDArray[Any]:
    """Decode a picture with OpenCV and its `flags`: (H, W) or, with blue first, (H, W, 3).

    Raises an `InputError` if the file is missing, or cannot be decoded; then `otherwise` follows its path in the message.
    """
    import cv2

    with reading(path, otherwise):
        picture = cv2.imdecode(np.fromfile(path, np.uint8), flags)
    if picture is None:
        raise InputError(f"{path} {otherwise}")
    return picture


def bayer_array(order: Bayer, shape: tuple[int, int]) -> NDArray[np.int8]:
    """Return the place in `COLOURS` of the colour that each pixel behind a Bayer array sees: (H, W)."""
    tile = np.array([_LETTERS.index(letter) for letter in order], np.int8).reshape(2, 2)
    return np.tile(tile, (-(-shape[0] // 2), -(-shape[1] // 2)))[: shape[0], : shape[1]]


def read_filter_array(path: Path) -> NDArray[np.int8]:
    """Read the place in `COLOURS` of the colour that each pixel sees: (H, W).

    Args:
        path: a .png picture, or a .npy file (height, width, 3) of uint8 in the order red, green, blue; clear pixels are white,
            the others pure red, green or blue.

    Raises:
        InputError: the file is missing, holds something else, or has other colours.
    """
    if path.suffix.lower() == ".png":
        import cv2

        picture = read_picture(path, f"is not {_WHAT}: it is no picture that can be read", cv2.IMREAD_COLOR)
        pattern = np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)
    else:
        pattern = read_array(path, _WHAT)
        if pattern.dtype != np.uint8 or pattern.ndim != 3 or pattern.shape[2] != 3:
            found = f"{pattern.dtype} values of shape {pattern.shape}"
            raise InputError(f"{path} holds {found}; a pattern is a .npy file of uint8 (height, width, 3)")
    places = np.full(pattern.shape[:2], -1, np.int8)
    for place, colour in enumerate(COLOURS.values()):
        places[np.all(pattern == colour, axis=-1)] = place
    if (places < 0).any():
        row, column = np.argwhere(places < 0)[0].tolist()
        raise InputError(
            f"{path} has the colour {tuple(pattern[row, column].tolist())} at row {row}, column {column}; a "
            "pattern has white for clear pixels, and pure red, green and blue"
        )
    return places
