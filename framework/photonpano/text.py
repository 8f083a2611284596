"""Words for messages: lists, numbers, sizes, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

_MOST = 3  # the largest number of names that are suggested
_SAME_WORD = 0.8  # the similarity of two words from which one counts as a misspelling of the other


def listed(words: Iterable[str], last: str = "and") -> str:
    """Join words as a sentence does: `a, b and c`."""
    words = list(words)
    return f" {last} ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def columns(rows: Sequence[Sequence[str]]) -> str:
    """Align rows of text in columns: two spaces apart, no line wrapped, no trailing spaces."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def install_line(installs: Iterable[str]) -> str:
    """Return the line that installs extras and libraries, such as `photonpano[s3]`, from an index and from a checkout."""
    from_index = " ".join(f'"{install}"' for install in dict.fromkeys(installs))
    in_checkout = from_index.replace('"photonpano[', '".[')
    return f"pip install {from_index}" + (f" (in a checkout: pip install {in_checkout})" if in_checkout != from_index else "")


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


def count(number: int) -> str:
    """Write a whole number with a comma at each thousand."""
    return f"{number:,}"


def counted(number: int, singular: str, plural: str | None = None) -> str:
    """Write a whole number and its noun, in the singular or plural."""
    return f"{count(number)} {singular if number == 1 else plural or singular + 's'}"


def duration(seconds: float) -> str:
    """Write a time with the unit that fits, to three digits."""
    for limit, factor, unit in ((1e-3, 1e6, "µs"), (1, 1e3, "ms")):
        if seconds < limit:
            return f"{three_digits(seconds * factor)} {unit}"
    if seconds < 59.95:
        return f"{three_digits(seconds)} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(minutes, 60)
    return f"{count(hours)} h {minutes:02d} min"


def rate(hertz: float) -> str:
    """Write a frame rate with the unit that fits."""
    for limit, unit in ((1e6, "MHz"), (1e3, "kHz")):
        if hertz >= limit:
            return f"{three_digits(hertz / limit)} {unit}"
    return f"{three_digits(hertz)} Hz"


def pixels(value: float | None) -> str:
    """Write a distance in pixels; a dash if there is none."""
    return "\N{EN DASH}" if value is None else f"{value:.2g}" if abs(value) < 0.1 else three_digits(value)


def share(value: float) -> str:
    """Write a share as a percentage; 100 % and 0 % are exact."""
    percent = 100 * value
    if 99.5 <= percent < 100:
        return "over 99 %"
    if 0 < percent < 0.5:
        return "under 1 %"
    return f"{percent:.0f} %"


def span(start: int, stop: int) -> str:
    """Write a half-open frame span with its first and its last frame."""
    return count(start) if stop - start == 1 else f"{count(start)} to {count(stop - 1)}"


def suggestion(name: str, known: Iterable[str]) -> str:
    """Return `did you mean 'x'?` or `known: x, y and z`, to complete the message for an unknown name; empty if none is known.

    Case, and the choice between hyphen and underscore, do not count as differences. A name is near if one of its words is:
    `opencv-orb` to `orb`.
    """
    by_shape = {_shape(each): each for each in sorted(known)}
    near = difflib.get_close_matches(_shape(name), by_shape, _MOST)
    if not near:
        near = [each for each in by_shape if difflib.get_close_matches(_shape(name), each.split("-"), 1, _SAME_WORD)][:_MOST]
    if near:
        return f"did you mean {listed((repr(by_shape[shape]) for shape in near), 'or')}?"
    return f"known: {listed(by_shape.values())}" if by_shape else ""


def _shape(name: str) -> str:
    return name.lower().replace("_", "-")
