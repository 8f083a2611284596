"""Measure accuracy, reliability and speed of every locator: the table of docs/how-to/choose-a-locator.md.

    python tests/benchmarks/locators.py docs/how-to/choose-a-locator.md [--scenes 2] [--fluxes 0.5 0.1 0.02]

Every locator that is installed and needs no key registers the same pairs of virtual exposures, of the built-in street: groups
of 250 frames of 254x496 pixels, one and two group lengths apart, each with a pan of 25 px and tremor. Groups are merged as at
level 1, blurred and without a start; and as at the last level, along the true motion, with a start whose corners are 2 px off.
Times are those of one thread, per pair, to describe the exposures and to register the pairs.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from harness import command, simulator, table, took, write_tables
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
from photonpano.contracts.protocols import KnowsTruth
from photonpano.geometry import FrameTrajectory, corner_displacements, corners, inverse, normalised, transform_points
from photonpano.plugins.registry import Catalog
from photonpano_core.configs import PhotonMleConfig
from photonpano_core.mergers import PhotonMleMerger

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


def views(flux: float, seed: int, compensated: bool) -> Views:
    """Simulate a capture, and merge its groups."""
    shake = {"rms_px": 1.0, "frequencies_hz": [25.0, 90.0, 180.0]}
    capture = simulator(
        scene={"kind": "street", "seed": seed},
        path={"kind": "random-spline", "seed": seed, "length_px": 25 * GROUPS, "shake": shake},
        flux=flux,
        n_frames=GROUP_SIZE * GROUPS,
        frame_shape=SHAPE,
    )
    merger = PhotonMleMerger(PhotonMleConfig(compensate=compensated))
    with open_source(parse_spec(capture)) as source:
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
    wrong = transform_points(true, corners(SHAPE)) + WRONG_PX * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return normalised(cv2.getPerspectiveTransform(corners(SHAPE).astype(np.float32), wrong.astype(np.float32)))


def measured(locator: Locator, captures: Sequence[Views], known: bool) -> Sequence[str]:
    """Register all pairs, from a start that is nearly right if `known`, without a start otherwise.

    Returns:
        The median error of the located pairs, the share of the lost ones, and the time of a pair.
    """
    errors, pairs, seconds = [], 0, 0.0
    rng = np.random.default_rng(0)
    for capture in captures:
        features, _, spent, _ = took(lambda exposures: list(map(locator.describe, exposures)), capture.exposures)
        seconds += spent
        for moving, fixed, true in capture.pairs():
            start = nearly(true, rng) if known else None
            motion, _, spent, _ = took(locator.register, features[moving], features[fixed], start)
            seconds += spent
            pairs += 1
            if isinstance(motion, Located):
                errors.append(corner_displacements(motion.homography, true, SHAPE).mean())
    error = f"{np.median(errors):.3f} px" if errors else "-"
    return error, f"{1 - len(errors) / pairs:.0%}", f"{1000 * seconds / pairs:.0f} ms"


def rows(fluxes: Sequence[float], scenes: int) -> Iterator[Sequence[str]]:
    """Yield a row for each locator and flux, with blurred and with compensated exposures."""
    catalog = discover()
    for flux in fluxes:
        kinds = [[views(flux, seed, compensated) for seed in range(scenes)] for compensated in (False, True)]
        for name, locator in available(catalog, kinds[0][0].context):
            # The first pair takes longer: code is compiled and libraries are loaded.
            measured(locator, [Views(kinds[1][0].exposures[:2], *kinds[1][0][1:])], known=True)
            blurred, compensated = (measured(locator, each, known) for each, known in zip(kinds, (False, True), strict=True))
            yield f"{flux:g}", name, *blurred, *compensated


def main(page: Path | None, scenes: int = 2, fluxes: Sequence[float] = (0.5, 0.1, 0.02)) -> None:
    """Measure everything, and write the page."""
    cv2.setNumThreads(1)
    head = ("Flux", "Locator", "Blurred: error", "lost", "a pair", "Compensated: error", "lost", "a pair")
    write_tables(page, {"table": table(head, rows(fluxes, scenes))})


if __name__ == "__main__":
    command(main, "table")
