"""Format numbers for people."""

from __future__ import annotations

from photonpano.text import three_digits


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
