"""What to offer to somebody who mistyped a name."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


_MOST = 3
_SAME_WORD = 0.8
"""How similar two words are that differ by a slip."""


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
    """Complete "there is no such name": the nearest of the known names, else all of them.

    Case, and the choice between hyphen and underscore, do not count as a difference. One word of a name is near to it: `orb` to
    `opencv-orb`.

    Returns:
        `did you mean 'x'?` or `known: x, y and z`; empty if nothing is known.
    """
    by_shape = {_shape(each): each for each in sorted(known)}
    near = difflib.get_close_matches(_shape(name), by_shape, _MOST) or _with_word(_shape(name), by_shape)
    if near:
        return f"did you mean {listed((repr(by_shape[shape]) for shape in near), 'or')}?"
    return f"known: {listed(by_shape.values())}" if by_shape else ""


def _with_word(word: str, shapes: Iterable[str]) -> list[str]:
    """Return names of which one word is much like this one."""
    return [each for each in shapes if difflib.get_close_matches(word, each.split("-"), 1, _SAME_WORD)][:_MOST]


def _shape(name: str) -> str:
    return name.lower().replace("_", "-")
