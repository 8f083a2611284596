"""photonpano dark."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from photonpano.cli.options import CapturePath, Corrections, Keys, SourceName

if TYPE_CHECKING:
    from photonpano.api.dark_counts import DarkMeasurement


def dark(
    path: CapturePath,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="An .npz file for the dark counts, or a .npy file for a mask.",
            show_default=False,
        ),
    ],
    threshold: Annotated[
        float, typer.Option(min=0, metavar="STD", help="Pixels are hot above the median by this many standard deviations.")
    ] = 10,
    source: SourceName = None,
    keys: Keys = None,
    corrections: Corrections = None,
) -> None:
    """Measure dark counts and hot pixels, with the lens covered.

    Record the capture with the lens covered. An .npz file holds the dark counts of each pixel, for the corrections hot-pixels
    and dark-counts; a .npy file holds the mask of the hot pixels. Corrections that move pixels are applied before, so list the
    file after them in a spec.

    Example: photonpano dark covered.npy --output dark.npz
    """
    from photonpano.api.dark_counts import dark as measure_dark
    from photonpano.cli.errors import warn
    from photonpano.cli.options import capture_plan
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.tables import columns
    from photonpano.registry.description import flow

    with capture_plan(path, source, keys, corrections) as plan:
        measured = measure_dark(plan, output, threshold, progress_for_stderr())
    for warning in measured.warnings:
        warn(warning)
    typer.echo(columns(_rows(measured)))
    typer.echo(f"\nIn a spec in this folder:\n\ncorrections: {flow(list(measured.corrections))}")


def _rows(measured: "DarkMeasurement") -> list[list[str]]:
    import numpy as np

    rates = measured.rates[measured.valid]
    median, p90, p99, highest = np.quantile(rates, [0.5, 0.9, 0.99, 1]).tolist()
    n_hot, n_pixels = int(measured.hot.sum()), rates.size
    return [
        [str(measured.path), f"from {measured.info}"],
        ["dark counts per frame", f"median {median:.2g}, 90 % {p90:.2g}, 99 % {p99:.2g}, highest {highest:.2g}"],
        ["hot pixels", f"{n_hot:,} of {n_pixels:,} ({100 * n_hot / n_pixels:.2f} %), above {measured.limit:.2g}"],
    ]
