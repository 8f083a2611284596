"""The errors that users meet: each message has what happened, where, and what to do.

Everything raised on purpose derives from `PhotonpanoError`; anything else that escapes is a defect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


class PhotonpanoError(Exception):
    """Base of all errors with a message made for users."""

    report: Path | None = None  # a page about the run that failed; None where there is none


class InputError(PhotonpanoError):
    """A capture, mask, truth or other input file cannot be used as it is."""


class ExtentError(InputError):
    """No frame shows the part of the panorama that is to be rendered."""


class ProjectionError(InputError):
    """The motion does not suit the projection that was asked for."""


class LocationError(PhotonpanoError):
    """Too few exposures could be located against each other to go on."""


class CanvasTooLargeError(PhotonpanoError):
    """The predicted panorama exceeds the limit of the spec."""


class OutputError(PhotonpanoError):
    """A result could not be written; nothing is left under its final name."""


class CaptureUnreadError(PhotonpanoError):
    """A component needs a measurement of the capture, where no frames are read."""


class PluginError(PhotonpanoError):
    """A plugin is broken, missing a library, in conflict with another, or broke its contract."""


_LONGEST = 200  # characters of a path in a spec, or of an override, that a message shows


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One thing that is wrong with a spec."""

    where: str  # path inside the spec, such as `locate.with.ratio`; empty for the file as a whole
    message: str  # what was expected and what was given
    file: Path | None = None  # the spec file, None for a spec that was built in Python
    line: int | None = None  # line in the file, from 1; None if unknown
    column: int | None = None  # column in the line, from 1; None if unknown
    override: str | None = None  # what has put the value there from outside of the file, such as `locate.with.ratio=0.7`

    def __str__(self) -> str:
        position = [str(part) for part in (self.file, self.line, self.column) if part is not None]
        head = ":".join(position)
        message = f"{self.message} (in the override {_cut(self.override)})" if self.override else self.message
        return ": ".join(part for part in (head, _cut(self.where), message) if part)


def _cut(text: str) -> str:
    """Return a text for a line of a message: without control characters, and not much longer than a line."""
    shown = "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text[:_LONGEST])
    return shown if len(text) <= _LONGEST else f"{shown}..."


def described(error: BaseException) -> str:
    """Describe an exception that is not for users: its type and its message, even if that cannot be written."""
    try:
        message = str(error)
    except Exception:
        message = "(its message cannot be written)"
    return f"{type(error).__name__}: {message}" if message else type(error).__name__


def public_name(error: BaseException) -> str:
    """Return the name of the class of an exception; of errors of photonpano, that of the class in this module."""
    classes = (each for each in type(error).__mro__ if each.__module__ == __name__)
    return next(classes, type(error)).__name__


class SpecError(PhotonpanoError):
    """A spec is wrong; carries every problem that was found, not only the first."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))
