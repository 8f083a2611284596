"""Runs with a gyroscope: captures too dark to be located, and rates that are those of another one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import InputError, LocationError, SpecError, evaluate, parse_spec, run, simulate
from photonpano.testing import measured_rates

pytestmark = pytest.mark.usefixtures("without_report")

TRUTH = {"bias_deg_s": (0.5, -0.4, 0.3), "offset_s": 0.03}
SIMULATED: dict[str, Any] = {
    "scene": {"kind": "street", "width": 768, "height": 384},
    "path": {"kind": "turn", "degrees": 40, "pitch_wobble_deg": 3, "roll_wobble_deg": 2, "wobbles": 2},
    "frame_shape": [64, 96],
    "focal_length_px": 122,
    "flux": 0.005,
    "n_frames": 600,
    "frame_rate_hz": 1000,
}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A turn by 40 degrees in 0.6 s, in 0.005 photons per pixel per frame."""
    path = tmp_path_factory.mktemp("turn") / "turn.npy"
    simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": SIMULATED}}), path)
    with np.load(path.with_suffix(".truth.npz")) as truth:
        rates = measured_rates(truth["rotations"], 1000.0, **TRUTH)
    path.with_name("imu.csv").write_text(rates)
    return path


def spec_of(capture: Path, name: str, **prior: Any) -> dict[str, Any]:
    """Return a spec; `prior` is of its gyroscope."""
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(capture), "frame_rate_hz": 1000}},
        "resample": {"use": "midpoint", "with": {"group_size": 50}},
        "levels": 1,
        "locate": {"use": "direct", "fallback": []},
        "motion": {"model": "rotation", "prior": {"imu": str(capture.with_name("imu.csv")), **prior}},
        "camera": {"focal_px": 122},
        "output": {"directory": str(capture.with_name(name))},
    }


@pytest.mark.parametrize("prior", [{}, {"time_offset_s": 0.03}], ids=["offset is found", "offset is given"])
def test_a_capture_too_dark_to_be_located_is_located_with_a_gyroscope(capture: Path, prior: dict[str, Any]) -> None:
    """Without one, no level of the graph is tied together."""
    result = run(parse_spec(spec_of(capture, "with", **prior)))
    scores = evaluate(result.directory, capture.with_suffix(".truth.npz"), oracle=False)
    assert scores.trajectory.mean_px < 0.5
    assert scores.honest_share > 0.95
    decisions = {each["what"]: each for each in json.loads((result.directory / "run.json").read_text())["decisions"]}
    assert decisions["gyroscope"]["value"].startswith("time offset 0.03")
    assert "is by the gyroscope" in decisions["gyroscope_agreement"]["reason"]


@pytest.mark.parametrize("scale", [0.0175, 57.3, -1.0])
def test_rates_in_other_units_or_of_another_capture_are_refused(capture: Path, tmp_path: Path, scale: float) -> None:
    """A scale of -1 is that of axes that point the other way."""
    lines = capture.with_name("imu.csv").read_text().splitlines()
    numbers = np.loadtxt(lines[1:], delimiter=",") * [1, scale, scale, scale]
    (file := tmp_path / "imu.csv").write_text("\n".join([lines[0], *(",".join(map(str, row)) for row in numbers)]))
    with pytest.raises((SpecError, LocationError), match=r"motion\.prior: photons do not fit|more than any usual gyroscope"):
        run(parse_spec(spec_of(capture, "other", imu=str(file))))


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ({"time_offset_s": 0.3}, r"of them, from 4\d\d to 599, are without; correct motion.prior.time_offset_s"),
        ({"imu": "short"}, "covers 0.2 s, and the capture takes 0.599 s: the time offset is found in files that cover it"),
    ],
)
def test_a_file_that_does_not_cover_the_capture_is_refused(
    capture: Path, tmp_path: Path, prior: dict[str, Any], message: str
) -> None:
    if "imu" in prior:
        lines = capture.with_name("imu.csv").read_text().splitlines()
        (file := tmp_path / "imu.csv").write_text("\n".join(lines[:202]))
        prior = {"imu": str(file)}
    with pytest.raises(InputError, match=message):
        run(parse_spec(spec_of(capture, "other", **prior)))
