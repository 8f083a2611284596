"""Measure what dead parts of a sensor cost, told by a mask or not.

    python tests/benchmarks/masks.py [--fluxes 0.3 0.01 0.001] [--kinds rows columns chips] [--seeds 1]

6,000 frames of 254x496 px sway on a spline of 60 px over the built-in street. 5 % of the pixels are dead: rows or columns at
random places, or the gaps of four chips. Each capture is run as it is, with the mask of the dead pixels, and without any dead
ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from harness import Study, chosen, command, packed, passing, record_of, scores_of, simulator, table

from photonpano import parse_spec, run
from photonpano.capture.writing import truth_path
from photonpano.values import BoolArray

SHAPE, N_FRAMES, DEAD = (254, 496), 6000, 0.05


def dead_rows(rng: np.random.Generator, axis: int = 0) -> BoolArray:
    """Return single rows, or columns, that are dead: (H, W), True there."""
    dead = np.zeros(SHAPE, bool)
    np.moveaxis(dead, axis, 0)[rng.choice(SHAPE[axis], round(DEAD * SHAPE[axis]), replace=False)] = True
    return dead


def gaps(_: np.random.Generator) -> BoolArray:
    """Return the gaps between four chips: (H, W), True there."""
    y, x = np.ogrid[: SHAPE[0], : SHAPE[1]]
    return np.asarray((abs(y - SHAPE[0] / 2) < DEAD / 4 * SHAPE[0]) | (abs(x - SHAPE[1] / 2) < DEAD / 4 * SHAPE[1]))


KINDS = {"rows": dead_rows, "columns": lambda rng: dead_rows(rng, 1), "chips": gaps}


def measured(study: Study, flux: float, kind: str, seed: int) -> Sequence[str]:
    """Return a row: the mean error in px over what is expected, and the verdict, of each of three runs."""
    scene, path = {"kind": "street", "width": 1024, "height": 682, "seed": seed}, {"kind": "random-spline", "length_px": 60}
    camera = simulator(scene=scene, path=path, flux=flux, n_frames=N_FRAMES, frame_shape=SHAPE, seed=seed)
    whole = study.capture(f"whole-{flux}-{seed}", camera)
    dead = KINDS[kind](np.random.default_rng(seed))
    mask, partly = whole.with_name("mask.npy"), whole.with_name("partly.npy")
    np.save(mask, dead)
    np.save(partly, np.load(whole) & ~np.packbits(dead, axis=1))
    truth_path(partly).write_bytes(truth_path(whole).read_bytes())
    corrections = {"corrections": [{"mask": {"file": str(mask)}}]}
    found = []
    for cube, sections in ((whole, {}), (partly, {}), (partly, corrections)):
        folder = whole.with_name("run")
        run(parse_spec(packed(cube, **sections), output=folder), overwrite=True)
        record, scores = record_of(folder), scores_of(folder, cube, oracle=False)
        found.append(f"{scores.trajectory.mean_px:.3f} of {record['motion']['std_px']:.3f}, {record['verdict']['status']}")
    return [f"{flux:g}", kind, str(seed), *found]


def main(
    fluxes: Sequence[float] = (0.3, 0.01, 0.001), kinds: Sequence[str] = ("",), seeds: int = 1, folder: Path | None = None
) -> None:
    """Print a table of all kinds of dead pixels at each flux."""
    with passing(folder) as study:
        cases = [(flux, kind, seed) for flux in fluxes for kind in chosen(kinds, KINDS) for seed in range(seeds)]
        table(["Flux", "Dead", "Seed", "None dead", "Not told", "Told"], (measured(study, *case) for case in cases))


if __name__ == "__main__":
    command(main)
