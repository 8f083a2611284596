"""How commands put captures and tables into words."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from photonpano.values import StreamInfo


def capture_words(info: StreamInfo) -> str:
    """Describe a capture, as in "4,000 binary frames of 254x496 at 96,800 Hz"."""
    kind = "binary" if info.kind == "binary" else f"{info.bit_depth}-bit"
    rate = "" if info.frame_rate_hz is None else f" at {info.frame_rate_hz:,.15g} Hz"
    return f"{info.n_frames:,} {kind} frames of {info.height}x{info.width}{rate}"


def columns(rows: Sequence[Sequence[str]]) -> str:
    """Align rows of text in columns: two spaces apart, no line wrapped, no trailing spaces."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)
