"""Words for messages: lists, numbers, sizes, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


_MOST = 3
"""The largest number of names that are suggested."""
_SAME_WORD = 0.8
"""The similarity of two words from which one counts as a misspelling of the other."""


def listed(words: Iterable[str], last: str = "and") -> str:
    """Join words as a sentence does: `a, b and c`."""
    words = list(words)
    return f" {last} ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def three_digits(value: float) -> str:
    """Write a number to three digits, without zeros at the end of its decimals."""
    decimals = 0 if abs(value) >= 99.95 else 1 if abs(value) >= 9.995 else 2
    text = f"{value:,.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def byte_size(n_bytes: int) -> str:
    """Write a number of bytes with the unit that fits."""
    value = float(n_bytes)
    for unit in ("B", "KiB", "MiB"):
        if value < 1000:
            return f"{three_digits(value)} {unit}"
        value /= 1024
    return f"{three_digits(value)} GiB"


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return the nearest of the known names, else all of them, to complete the message for an unknown name.

    Case, and the choice between hyphen and underscore, do not count as differences. A name is near if one of its words is:
    `opencv-orb` to `orb`.

    Returns:
        `did you mean 'x'?` or `known: x, y and z`; empty if nothing is known.
    """
    by_shape = {_shape(each): each for each in sorted(known)}
    near = difflib.get_close_matches(_shape(name), by_shape, _MOST) or _with_word(_shape(name), by_shape)
    if near:
        return f"did you mean {listed((repr(by_shape[shape]) for shape in near), 'or')}?"
    return f"known: {listed(by_shape.values())}" if by_shape else ""


def _with_word(word: str, shapes: Iterable[str]) -> list[str]:
    """Return the names that have a word which this one may be a misspelling of."""
    return [each for each in shapes if difflib.get_close_matches(word, each.split("-"), 1, _SAME_WORD)][:_MOST]


def _shape(name: str) -> str:
    return name.lower().replace("_", "-")
