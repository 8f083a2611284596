"""photonpano dark."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from photonpano.cli.capture import CapturePath, Corrections, Keys, SourceName

if TYPE_CHECKING:
    from photonpano.corrections import DarkFrames
    from photonpano.values import BoolArray, StreamInfo

BRIGHT = 0.1
"""Photons a frame, in half of the pixels of a binary capture, that no lens cap lets through."""


def dark(
    path: CapturePath,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="An .npz file for dark counts, a .npy file for a mask.", show_default=False
        ),
    ],
    threshold: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="STD",
            help="How far hot pixels stand out, in standard deviations; 10 by default.",
            show_default=False,
        ),
    ] = None,
    source: SourceName = None,
    keys: Keys = None,
    corrections: Corrections = None,
) -> None:
    """Measure dark counts and hot pixels, with the lens covered.

    The capture was recorded with the lens covered. Corrections that move pixels are applied, so that what is written fits
    behind them in the list of a spec. An .npz file holds the dark counts of each pixel, from which a spec takes dark
    counts or hot pixels; a .npy file holds the mask of the hot pixels.

    Example: photonpano dark covered.npy --output dark.npz
    """
    import numpy as np

    from photonpano.atomic import atomic_path
    from photonpano.cli.capture import opened
    from photonpano.cli.outcome import warn
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.wording import columns
    from photonpano.corrections import hot_in_the_dark, measure_dark, write_dark
    from photonpano.corrections.hot_pixels import THRESHOLD
    from photonpano.errors import InputError, OutputError
    from photonpano.registry.description import flow

    if output.suffix not in (".npz", ".npy"):
        raise OutputError(f"cannot write {output}: dark counts are an .npz file, and a mask of hot pixels is a .npy file")
    with opened(path, source, keys, corrections) as (plan, capture):
        info, valid = capture.info, capture.valid
        if not valid.any():
            raise InputError(f"{path}: no pixel may be used")
        with progress_for_stderr().stage("dark counts", info.n_frames, "frames") as advance:
            measured = measure_dark(capture, advance)
    hot, limit = hot_in_the_dark(measured, THRESHOLD if threshold is None else threshold, valid)
    with atomic_path(output) as temporary:
        if output.suffix == ".npz":
            write_dark(temporary, measured)
        else:
            np.save(temporary, hot)
    if info.kind == "binary" and np.median(measured.rates[valid]) > BRIGHT:
        warn(f"half of the pixels count more than {BRIGHT:g} a frame; was the lens covered?")
    typer.echo(columns(_rows(output, info, measured, hot & valid, limit, valid)))
    uses = {"hot-pixels": "dark", "dark-counts": "dark"} if output.suffix == ".npz" else {"mask": "file"}
    typer.echo("\nIn a spec that lies here:\n")
    listed = [*plan.document["corrections"], *({name: {key: str(output)}} for name, key in uses.items())]
    typer.echo(f"corrections: {flow(listed)}")


def _rows(
    output: Path, info: "StreamInfo", measured: "DarkFrames", hot: "BoolArray", limit: float, valid: "BoolArray"
) -> list[list[str]]:
    import numpy as np

    from photonpano.cli.wording import capture_words

    rates = measured.rates[valid]
    median, most, nearly_all, highest = np.quantile(rates, [0.5, 0.9, 0.99, 1]).tolist()
    n_hot, n_pixels = int(hot.sum()), int(valid.sum())
    return [
        [str(output), f"from {capture_words(info)}"],
        ["dark counts a frame", f"median {median:.2g}, 90 % {most:.2g}, 99 % {nearly_all:.2g}, highest {highest:.2g}"],
        ["hot pixels", f"{n_hot:,} of {n_pixels:,} ({100 * n_hot / n_pixels:.2f} %), above {limit:.2g}"],
    ]
