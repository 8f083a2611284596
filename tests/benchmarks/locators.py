"""Measure accuracy, reliability and speed of every locator: the table of docs/how-to/choose-a-locator.md.

    python tests/benchmarks/locators.py docs/how-to/choose-a-locator.md [--scenes 2] [--fluxes 0.5 0.1 0.02]

Every locator that is installed and needs no key registers the same pairs of virtual exposures, of the built-in street: groups
of 250 frames of 254x496 pixels, one and two group lengths apart, each with a pan of 25 px and tremor. Groups are merged as at
level 1, blurred and without a start; and as at the last level, along the true motion, with a start whose corners are 2 px off.
Times are those of one thread, per pair, to describe the exposures and to register the pairs.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from pages import require_places, write_tables
from pydantic import ValidationError

from photonpano import (
    FrameSpan,
    Group,
    Located,
    Locator,
    PhotonpanoError,
    PluginError,
    StageContext,
    VirtualExposure,
    discover,
    open_source,
    parse_spec,
)
from photonpano.geometry import FrameTrajectory, apply, corner_displacements, corners, inverse, normalised
from photonpano.protocols import KnowsTruth
from photonpano.registry import Catalog
from photonpano_core.configs import PhotonMleConfig
from photonpano_core.mergers.photon_mle import PhotonMleMerger

SHAPE = (254, 496)
GROUP_SIZE = 250
GROUPS = 6
WRONG_PX = 2.0


class Views(NamedTuple):
    """Exposures of one capture, with their true poses.

    Attributes:
        exposures: one for each group.
        to_plane: (N, 3, 3), pixels of the exposures to a common plane.
        context: context for locators of this capture.
    """

    exposures: list[VirtualExposure]
    to_plane: np.ndarray
    context: StageContext

    def pairs(self) -> Iterator[tuple[int, int, np.ndarray]]:
        """Yield the indices of the moving and the fixed exposure, and the true motion between them."""
        for apart in (1, 2):
            for fixed in range(len(self.exposures) - apart):
                moving = fixed + apart
                yield moving, fixed, inverse(self.to_plane[fixed]) @ self.to_plane[moving]


class Figures(NamedTuple):
    """Result of a locator on one kind of exposures: median error of located pairs, share of lost pairs, time."""

    error_px: float
    lost: float
    ms: float

    def __str__(self) -> str:
        error = "-" if np.isnan(self.error_px) else f"{self.error_px:.3f} px"
        return f"{error} | {self.lost:.0%} | {self.ms:.0f} ms"


def views(flux: float, seed: int, compensated: bool) -> Views:
    """Simulate a capture, and merge its groups."""
    simulator: dict[str, Any] = {
        "scene": {"kind": "street", "seed": seed},
        "path": {
            "kind": "random-spline",
            "seed": seed,
            "length_px": 25 * GROUPS,
            "shake": {"rms_px": 1.0, "frequencies_hz": [25.0, 90.0, 180.0]},
        },
        "flux": flux,
        "n_frames": GROUP_SIZE * GROUPS,
        "frame_shape": SHAPE,
    }
    merger = PhotonMleMerger(PhotonMleConfig(compensate=compensated))
    with open_source(parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator}})) as source:
        assert isinstance(source, KnowsTruth)
        trajectory = FrameTrajectory(source.truth()["homographies"])
        spans = (FrameSpan(start, start + GROUP_SIZE) for start in range(0, source.info.n_frames, GROUP_SIZE))
        groups = [Group(span, span.centre) for span in spans]
        exposures = [merger.merge(source, group, trajectory, 1.0) for group in groups]
        context = StageContext(source.info, source.response)
    return Views(exposures, trajectory.at([group.reference for group in groups]), context)


def available(catalog: Catalog, context: StageContext) -> Iterator[tuple[str, Locator]]:
    """Yield the locators that can be built here without any key."""
    for entry in catalog.rows:
        if entry.kind != "locator":
            continue
        try:
            locator = catalog.find("locator", entry.name).contribution
            if entry.unavailable:
                raise PluginError(entry.unavailable)
            yield entry.name, locator.build(locator.config(), context)
        except (PhotonpanoError, ValidationError) as error:
            print(f"{entry.name} is left out: {str(error).splitlines()[0]}", file=sys.stderr)


def nearly(true: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a start whose corners are 2 px off, each in a random direction."""
    angles = rng.uniform(0, 2 * np.pi, 4)
    wrong = apply(true, corners(SHAPE)) + WRONG_PX * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return normalised(cv2.getPerspectiveTransform(corners(SHAPE).astype(np.float32), wrong.astype(np.float32)))


def measure(locator: Locator, captures: Sequence[Views], known: bool) -> Figures:
    """Register all pairs, from a start that is nearly right if `known`, without a start otherwise."""
    errors, lost, seconds = [], 0, 0.0
    rng = np.random.default_rng(0)
    for capture in captures:
        began = time.process_time()
        features = [locator.describe(exposure) for exposure in capture.exposures]
        seconds += time.process_time() - began
        for moving, fixed, true in capture.pairs():
            start = nearly(true, rng) if known else None
            began = time.process_time()
            motion = locator.register(features[moving], features[fixed], start)
            seconds += time.process_time() - began
            if isinstance(motion, Located):
                errors.append(corner_displacements(motion.homography, true, SHAPE).mean())
            else:
                lost += 1
    pairs = len(errors) + lost
    return Figures(float(np.median(errors)) if errors else np.nan, lost / pairs, 1000 * seconds / pairs)


def table(fluxes: Sequence[float], scenes: int) -> list[str]:
    """Return the rows in Markdown: one for each locator and flux, for blurred and for compensated exposures."""
    rows = [
        "| Flux | Locator | Blurred: error | lost | a pair | Compensated: error | lost | a pair |",
        "| --- " * 8 + "|",
    ]
    catalog = discover()
    for flux in fluxes:
        kinds = [[views(flux, seed, compensated) for seed in range(scenes)] for compensated in (False, True)]
        for name, locator in available(catalog, kinds[0][0].context):
            # The first pair takes longer: code is compiled and libraries are loaded.
            measure(locator, [Views(kinds[1][0].exposures[:2], *kinds[1][0][1:])], known=True)
            blurred, compensated = (
                measure(locator, captures, known) for captures, known in zip(kinds, (False, True), strict=True)
            )
            rows.append(f"| {flux:g} | {name} | {blurred} | {compensated} |")
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Measure everything, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, help="the page whose table is replaced")
    parser.add_argument("--scenes", type=int, default=2, help="how many streets")
    parser.add_argument("--fluxes", type=float, nargs="+", default=[0.5, 0.1, 0.02], help="photons per pixel per frame")
    arguments = parser.parse_args()
    page: Path = arguments.page
    require_places(page, ["table"])
    cv2.setNumThreads(1)
    write_tables(page, {"table": table(arguments.fluxes, arguments.scenes)})


if __name__ == "__main__":
    main()
