"""What commands say of a capture that they have written."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from photonpano.values import StreamInfo


def tell_written(files: Sequence[Path], info: StreamInfo, unused: int) -> None:
    """Say what was written, and how a spec names it.

    Args:
        files: the capture and, if it has one, its truth.
        info: what the capture is like.
        unused: the number of its pixels that must not be used, which the file cannot say.
    """
    from rich.filesize import decimal

    from photonpano.cli.outcome import warn
    from photonpano.cli.wording import capture_words, columns
    from photonpano.registry.description import flow

    path, *truth = files
    if unused:
        warn(f"{unused} pixels are not to be used, which {path} does not say; mask them with `corrections`")
    words = [capture_words(info), "the truth: motion and scene"]
    typer.echo(columns([[str(file), decimal(file.stat().st_size), text] for file, text in zip(files, words, strict=False)]))
    typer.echo("\nIn a spec that lies here:\n")
    typer.echo(f"source: {flow({'use': 'packed-npy', 'with': _keys(path, info)})}")
    if truth:
        typer.echo(f"\nTo score a run of it: photonpano evaluate RUN --truth {truth[0]}")


def _keys(path: Path, info: StreamInfo) -> dict[str, Any]:
    keys: dict[str, Any] = {"path": str(path)}
    if info.frame_rate_hz is not None:
        keys["frame_rate_hz"] = info.frame_rate_hz
    if info.width % 8:
        keys["width"] = info.width
    return keys
