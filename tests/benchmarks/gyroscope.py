"""Measure what a gyroscope adds to captures of a camera that turns: the table of docs/how-to/gyroscope.md.

    python tests/benchmarks/gyroscope.py docs/how-to/gyroscope.md [--seeds 3] [--fluxes 0.3 0.03 0.01 0.003 0.0007]

Each capture is run without and with the rates, which are late and biased. Errors are those of the corners, on average over the
seeds; expected errors are `std_px`, of the runs with a gyroscope.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from harness import command, packed, passing, scores_of, simulator, table, write_tables

from photonpano import InputError, LocationError, load_trajectory, parse_spec, run
from photonpano.capture.writing import truth_path
from photonpano.testing import measured_rates

RATE_HZ, N_FRAMES, SHAPE, FOCAL_PX = 1000.0, 1000, (64, 96), 122
TURN = {"kind": "turn", "degrees": 60, "pitch_wobble_deg": 3, "roll_wobble_deg": 2, "wobbles": 2}
WRONG: dict[str, Any] = {"bias_deg_s": (0.5, -0.4, 0.3), "offset_s": 0.03}


def outcome(spec: dict[str, Any], folder: Path, capture: Path) -> tuple[float, float, str]:
    """Run a spec; return its error and expected error in px, NaN where it fails, and its verdict."""
    try:
        result = run(parse_spec(spec, output=folder))
    except (InputError, LocationError):
        return np.nan, np.nan, "not located"
    assert result.verdict is not None
    expected = float(np.mean(load_trajectory(folder).std_px))
    return scores_of(folder, capture, oracle=False).trajectory.mean_px, expected, result.verdict.status


def rows(seeds: int, fluxes: Sequence[float]) -> Iterator[Sequence[str]]:
    """Yield a row for each flux: errors without and with a gyroscope, and the expected error with it."""
    for flux in fluxes:
        found: dict[str, list[tuple[float, float, str]]] = {"without": [], "with": []}
        for seed in range(seeds):
            with passing() as study:
                turn = simulator(
                    scene={"kind": "street", "width": 768, "height": 384, "seed": seed},
                    path=TURN,
                    frame_shape=SHAPE,
                    focal_length_px=FOCAL_PX,
                    flux=flux,
                    n_frames=N_FRAMES,
                    frame_rate_hz=RATE_HZ,
                )
                capture = study.capture("turn", turn | {"run": {"seed": seed}})
                with np.load(truth_path(capture)) as truth:
                    rates = measured_rates(truth["rotations"], RATE_HZ, **WRONG)
                (imu := study.folder / "imu.csv").write_text(rates)
                for name, prior in (("without", {}), ("with", {"prior": {"imu": str(imu)}})):
                    motion = {"motion": {"model": "rotation", **prior}, "camera": {"focal_px": FOCAL_PX}}
                    found[name].append(outcome(packed(capture, RATE_HZ, **motion), study.folder / name, capture))
        expected = np.mean([each[1] for each in found["with"]])
        yield f"{flux:g}", *map(shown, found.values()), f"{expected:.2f}" if np.isfinite(expected) else "not known"


def shown(found: Sequence[tuple[float, float, str]]) -> str:
    """Return the mean error of runs, and how many were not located or doubtful."""
    located = [error for error, _, _ in found if np.isfinite(error)]
    error = f"{np.mean(located):.3f}" if located else ""
    words = (f"{n} of {len(found)} {what}" for what in ("not located", "doubtful") if (n := [v for *_, v in found].count(what)))
    return ", ".join(filter(None, (error, *words)))


def main(page: Path | None, seeds: int = 3, fluxes: Sequence[float] = (0.3, 0.03, 0.01, 0.003, 0.0007)) -> None:
    """Measure everything, and write the page."""
    head = ("Photons per pixel per frame", "Without", "With", "Expected, with")
    write_tables(page, {"table": table(head, rows(seeds, fluxes))})


if __name__ == "__main__":
    command(main, "table")
