"""Measure dark counts and hot pixels, with the lens covered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer

from photonpano.api.command import command, warn
from photonpano.corrections import hot_in_the_dark, measure_dark, write_dark
from photonpano.corrections.hot_pixels import THRESHOLD
from photonpano.errors import InputError, OutputError
from photonpano.execution.context import Progress, usual
from photonpano.files.atomic import atomic_path
from photonpano.files.folders import require_new
from photonpano.pipeline.components import build_source
from photonpano.plugins.registry.description import flow
from photonpano.specs import Plan
from photonpano.specs.corrections import written_corrections
from photonpano.text import columns
from photonpano.values import BoolArray, FluxImage, StreamInfo

BRIGHT = 0.1  # median photons per frame above which a binary capture was not recorded with the lens covered


@dataclass(frozen=True, slots=True, eq=False)
class DarkMeasurement:
    """Dark counts and hot pixels, measured by `dark`.

    Attributes:
        path: the file that was written.
        info: the size and rate of the capture.
        rates: (H, W) float32, dark counts per frame.
        valid: (H, W) bool, the pixels that are not masked.
        hot: (H, W) bool, the valid pixels that are hot.
        limit: the rate above which a pixel is hot.
        corrections: the corrections of a spec for this camera: those of the plan, then those that use the file.
        warnings: what is wrong with the capture, a sentence each.
    """

    path: Path
    info: StreamInfo
    rates: FluxImage
    valid: BoolArray
    hot: BoolArray
    limit: float
    corrections: Sequence[Any]
    warnings: tuple[str, ...]


def _lines(measured: DarkMeasurement) -> Iterator[str]:
    for warning in measured.warnings:
        warn(warning)
    rates = measured.rates[measured.valid]
    median, p90, p99, highest = np.quantile(rates, [0.5, 0.9, 0.99, 1]).tolist()
    n_hot, n_pixels = int(measured.hot.sum()), rates.size
    rows = [
        [str(measured.path), f"from {measured.info}"],
        ["dark counts per frame", f"median {median:.2g}, 90 % {p90:.2g}, 99 % {p99:.2g}, highest {highest:.2g}"],
        ["hot pixels", f"{n_hot:,} of {n_pixels:,} ({100 * n_hot / n_pixels:.2f} %), above {measured.limit:.2g}"],
    ]
    yield columns(rows)
    yield f"\nIn a spec in this folder:\n\ncorrections: {flow(list(measured.corrections))}"


@command(
    "covered.npy --output dark.npz",
    _lines,
    plan="capture",
    output=typer.Option("--output", "-o", metavar="FILE"),
    threshold=typer.Option(min=0, metavar="STD"),
)
def dark(
    plan: Plan,
    output: Path | str,
    threshold: float = THRESHOLD,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
) -> DarkMeasurement:
    """Measure dark counts and hot pixels in a capture that was recorded with the lens covered, and write them.

    Corrections that move pixels are applied before, so list the file after them in a spec.

    Args:
        plan: of the capture; corrections that move pixels are applied.
        output: an .npz file for the dark counts of each pixel, which the corrections `hot-pixels` and `dark-counts` take; or a
            .npy file for the mask of the hot pixels.
        threshold: hot pixels are above the median by this many standard deviations.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.
        overwrite: replace the file that is there under this name.

    Raises:
        InputError: all pixels are masked.
        OutputError: the file has another suffix, is there already, or cannot be written.
    """
    output = Path(output)
    if output.suffix not in (".npz", ".npy"):
        raise OutputError(f"cannot write {output}: dark counts are an .npz file, and a mask of hot pixels is a .npy file")
    require_new(output, overwrite)
    with build_source(plan) as source:
        info, valid = source.info, source.valid
        if not valid.any():
            raise InputError("dark counts cannot be measured: all pixels of the capture are masked")
        with usual(progress).stage("dark counts", info.n_frames, "frames") as advance:
            measured = measure_dark(source, advance)
    hot, limit = hot_in_the_dark(measured, threshold, valid)
    with atomic_path(output) as temporary:
        if output.suffix == ".npz":
            write_dark(temporary, measured)
        else:
            np.save(temporary, hot)
    warnings = []
    if info.kind == "binary" and np.median(measured.rates[valid]) > BRIGHT:
        warnings.append(f"half of the pixels count more than {BRIGHT:g} photons per frame; was the lens covered?")
    uses = {"hot-pixels": "dark", "dark-counts": "dark"} if output.suffix == ".npz" else {"mask": "file"}
    corrections = [*written_corrections(plan.corrections), *({name: {key: str(output)}} for name, key in uses.items())]
    return DarkMeasurement(output, info, measured.rates, valid, hot & valid, limit, corrections, tuple(warnings))
