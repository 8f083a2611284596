"""Measure what each part of the method contributes to the accuracy: table and plot of docs/explanation/ablation.md.

    python tests/benchmarks/ablation.py docs/explanation/ablation.md

Every locator, graph and resampler runs on the same captures: the built-in street, a path of 360 px in 2,400 frames with tremor.
The last row of each flux is the Cramer-Rao bound. It takes some minutes; `--fluxes` measures fewer, and draws no plot then.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from bounds import exposure_bound_px
from harness import IMAGES, Study, command, packed, passing, scores_of, seen, simulator, table, write_tables

from photonpano import PhotonpanoError
from photonpano.capture.writing import truth_path
from photonpano.evaluation import load_truth
from photonpano.photometry import BinaryResponse

FLUXES = (0.5, 0.1, 0.02)
GROUP_SIZE = 250
LOCATORS = ("opencv-sift", "direct")
GRAPHS: dict[str, dict[str, Any]] = {"chain": {"skips": [], "closure_overlap": None}, "full": {}}
RESAMPLERS = {"constant": "constant-groups", "midpoint": "midpoint"}
CAPTURE: dict[str, Any] = {
    "scene": {"kind": "street", "seed": 0},
    "path": {"kind": "random-spline", "length_px": 360, "shake": {"rms_px": 1.0, "frequencies_hz": [25.0, 90.0, 180.0]}},
    "n_frames": 2400,
    "frame_shape": [254, 496],
}


def measured(study: Study, cube: Path, locator: str, graph: str, resampler: str) -> tuple[float, float, float] | str:
    """Return the mean and the largest corner error, in px, and dB below the oracle; or why the run failed."""
    spec = packed(
        cube,
        resample={"use": RESAMPLERS[resampler], "with": {"group_size": GROUP_SIZE}},
        locate={"use": locator},
        graph=GRAPHS[graph] | {"disconnected": "largest"},
    )
    try:
        scores = scores_of(study.run("run", spec), cube)
    except PhotonpanoError as error:
        return f"failed: {str(error).splitlines()[0]}"
    assert scores.below_oracle_db is not None
    return scores.trajectory.mean_px, scores.trajectory.max_px, scores.below_oracle_db


def bound_px(cube: Path) -> float:
    """Return the mean, over the capture, of the Cramer-Rao bound of an exposure of a known scene."""
    truth = load_truth(truth_path(cube))
    assert truth.scene is not None
    views = (seen(truth.scene, to_scene, truth.frame_shape) for to_scene in truth.homographies[::200])
    return float(np.mean([exposure_bound_px(view, BinaryResponse(), GROUP_SIZE) for view in views]))


def rows(fluxes: Sequence[float], errors: dict[tuple[str, ...], list[float]]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table, and note the mean errors of each variant."""
    for flux in fluxes:
        with passing() as study:
            cube = study.capture("street", simulator(**CAPTURE, flux=flux))
            for names in itertools.product(LOCATORS, GRAPHS, RESAMPLERS):
                found = measured(study, cube, *names)
                failed = isinstance(found, str)
                errors.setdefault(names, []).append(np.nan if failed else found[0])
                figures = (found, "", "") if failed else "{:.3f} px|{:.2f} px|{:.2f} dB".format(*found).split("|")
                yield f"{flux:g}", *names, *figures
            errors.setdefault(("bound",), []).append(bound_px(cube))
            yield f"{flux:g}", "*Cramer-Rao bound*", "", "", f"{errors['bound',][-1]:.3f} px", "", ""


def plot(errors: dict[tuple[str, ...], list[float]], file: Path) -> None:
    """Draw the mean error of each variant over the flux."""
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    styles = {"chain": ":", "full": "-"}
    colours = {("opencv-sift", "constant"): "#c8a26b", ("opencv-sift", "midpoint"): "#a8641e"}
    colours |= {("direct", "constant"): "#8fb0cf", ("direct", "midpoint"): "#1f5a94"}
    for locator, graph, resampler in itertools.product(LOCATORS, GRAPHS, RESAMPLERS):
        line = {"marker": "o", "markersize": 4, "color": colours[locator, resampler]}
        label = f"{locator}, {graph}, {resampler}"
        axes.loglog(FLUXES, errors[locator, graph, resampler], styles[graph], label=label, **line)
    axes.loglog(FLUXES, errors["bound",], color="black", linewidth=1, label="Cramer-Rao bound")
    axes.set_xticks(FLUXES, [f"{flux:g}" for flux in FLUXES])
    axes.set_xticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("flux (photons per pixel per frame)")
    axes.set_ylabel("mean corner error (px)")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", frameon=False, title="locator, graph, groups")
    figure.savefig(file, dpi=110)


def main(page: Path | None, fluxes: Sequence[float] = FLUXES) -> None:
    """Measure everything, and write the page."""
    errors: dict[tuple[str, ...], list[float]] = {}
    head = ("Flux", "Locator", "Graph", "Groups", "Mean", "Worst frame", "Below the oracle")
    write_tables(page, {"table": table(head, rows(fluxes, errors))})
    if page and tuple(fluxes) == FLUXES:
        plot(errors, IMAGES / "ablation.png")


if __name__ == "__main__":
    command(main, "table")
