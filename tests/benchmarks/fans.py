"""How exact runs are that start from a constant velocity: fans whose turn changes, and which the camera sees at a slant.

python tests/benchmarks/fans.py docs/how-to/constant-velocity.md
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from harness import command, passing, seen, table, to_reference, write_tables
from numpy.typing import NDArray

from photonpano import load_trajectory, parse_spec, run
from photonpano.evaluation import corner_errors
from photonpano.geometry import inverse, translation
from photonpano_simulator.scenes import street

SHAPE, N_FRAMES, FLUX = (192, 256), 160, 0.08
AXIS, TURN_DEG, GROUP = (130.0, 100.0), 3.4, 16
ENDS = GROUP // 2  # frames before the middle of the first exposure, and after that of the last
# Each fan: how much its turn grows, in degrees a frame by frame; its sway, in degrees; and the slant, as a share of the height.
FANS = {"nearly even": (0.001, 0.3, 0.04), "uneven": (0.004, 1.5, 0.07)}


def motion(growth: float, sway_deg: float, slant: float) -> NDArray[np.float64]:
    """Return the maps of the frames to a plane that turns about its origin."""
    times = np.arange(N_FRAMES) - N_FRAMES / 2
    angles = -np.deg2rad(TURN_DEG * times + growth / 2 * times**2 + sway_deg * np.sin(times / 25))
    turns = np.array([[[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]] for a in angles])
    return turns @ inverse(np.diag([1, 1 - slant, 1])) @ translation(-AXIS[0], -AXIS[1])


def measured(name: str, seed: int, folder: Path) -> tuple[object, ...]:
    """Simulate a fan, run it, and return the row of its errors."""
    true, rng = motion(*FANS[name]), np.random.default_rng(seed)
    picture = street((600, 600), seed)
    scene = (picture * (FLUX / picture.mean())).astype(np.float32)
    on_scene = translation(300, 300) @ np.diag([1.2, 1.2, 1]) @ true
    np.save(folder / "fan.npy", np.array([rng.random(SHAPE) < -np.expm1(-seen(scene, each, SHAPE)) for each in on_scene]))
    spec = {
        "version": 1,
        "source": {"use": "npy", "with": {"path": str(folder / "fan.npy"), "holds": "bits"}},
        "motion": {"start": "constant-velocity", "model": "homography"},
        "resample": {"with": {"group_size": GROUP}},
        "locate": {"use": "direct", "fallback": []},
        "render": {"extent": "reference"},
    }
    verdict = run(parse_spec(spec, output=folder / "run"), overwrite=True).record["verdict"]["status"]
    score = corner_errors(load_trajectory(folder / "run").homographies, to_reference(true), SHAPE)
    ends = np.r_[score.errors_px[:ENDS], score.errors_px[-ENDS:]].mean()
    rates = np.abs(np.diff(np.unwrap(np.arctan2(true[:, 1, 0], true[:, 0, 0])))) / np.deg2rad(TURN_DEG) - 1
    return (
        name,
        f"{100 * np.abs(rates).max():.0f} %",
        seed,
        verdict,
        *(f"{px:.2f}" for px in (score.mean_px, ends, score.max_px)),
    )


def main(page: Path | None, seeds: int = 3, folder: Path | None = None) -> None:
    """Measure all fans, and write the table."""

    def rows() -> Iterator[tuple[object, ...]]:
        with passing(folder) as study:
            for name in FANS:
                yield from (measured(name, seed, study.folder) for seed in range(seeds))

    head = ("Fan", "Turn changes by", "Seed", "Verdict", "Mean error, px", "In the first and last 8 frames", "Worst frame")
    write_tables(page, {"fans": table(head, rows())})


if __name__ == "__main__":
    command(main, "fans")
