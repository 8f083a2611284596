"""Panoramas of a simulated high-speed camera: 90 frames of 128x160 px at 500 Hz, 2.7 px a frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from photonpano import evaluate, open_source, run
from photonpano.cli.app import app
from photonpano.evaluation import Evaluation
from photonpano.specs import parse_spec

pytestmark = pytest.mark.usefixtures("without_report")

SHAKE = {"rms_px": 1.0, "frequencies_hz": [3, 5, 8]}
CAMERA = {
    "scene": {"kind": "street", "width": 1024, "height": 682},
    "path": {"kind": "pan", "length_px": 240, "angle_deg": 10, "shake": SHAKE},
    "n_frames": 90,
    "frame_shape": [128, 160],
}


def camera(light: float = 1, read_noise: float = 20) -> dict[str, Any]:
    """Return the source section of the simulated camera, with the light multiplied by a factor."""
    sensor = {"full_well": 10_000 * light, "read_noise": read_noise, "exposure": 0.5}
    return {"use": "camera-simulator", "with": CAMERA | {"flux": 1500 * light, "sensor": sensor}}


@pytest.fixture
def scored(tmp_path: Path) -> Callable[..., tuple[Evaluation, dict[str, Any]]]:
    """Run a spec, and return its scores and its record."""

    def scored(
        simulated: dict[str, Any], source: dict[str, Any], oracle: bool = True, **sections: Any
    ) -> tuple[Evaluation, dict[str, Any]]:
        with open_source(parse_spec({"version": 1, "source": simulated})) as opened:
            np.savez(tmp_path / "truth.npz", **opened.truth())
        result = run(parse_spec({"version": 1, "source": source, **sections}, output=tmp_path / "run"), overwrite=True)
        return evaluate(result.directory, tmp_path / "truth.npz", oracle=oracle), result.record

    return scored


def test_noisy_compressed_video_is_nearly_as_accurate_as_clean_one(write_video: Callable, scored: Callable) -> None:
    """Measured: 0.05 and 0.02 px, 28.2 and 31.5 dB."""

    def of_video(simulated: dict[str, Any], *how: str, **options: Any) -> tuple[Evaluation, dict[str, Any]]:
        with open_source(parse_spec({"version": 1, "source": simulated})) as opened:
            path = write_video(opened.frames(opened.info.span), *how, **options)
        sensor = simulated["with"]["sensor"]
        response = {"saturation_photons": sensor["full_well"], "read_noise": sensor["read_noise"]}
        return scored(simulated, {"use": "video", "with": {"path": str(path), "response": response}})

    noisy, record = of_video(camera(), "noisy.mp4", "libx264", "yuvj420p", crf=23)
    clean, _ = of_video(camera(light=100, read_noise=0), "clean.mkv", "ffv1", "gray")
    assert clean.trajectory.mean_px < 0.1
    assert noisy.trajectory.mean_px < 0.15
    assert noisy.oracle.psnr_db - noisy.panorama.psnr_db < 0.5
    assert clean.panorama.psnr_db - 5 < noisy.panorama.psnr_db < clean.panorama.psnr_db
    (chosen,) = [decision for decision in record["decisions"] if decision["what"] == "group_size"]
    assert chosen["value"] < 16  # the least of binary frames
    # The gain is that of the spec, so that the flux is in photons.
    assert record["panorama"]["white_flux"] == pytest.approx(noisy.white_flux, rel=0.2)


@pytest.mark.parametrize(
    "sections",
    [
        {"resample": {"with": {"group_size": 1}}, "levels": 1},
        {"resample": {"with": {"group_size": 3}}, "merge": {"use": "robust-merge"}, "levels": 2},
        {"resample": {"with": {"group_size": 5}}, "merge": {"use": "splat"}, "levels": 2},
        {"resample": {"use": "constant-groups", "with": {"group_size": 5}}, "locate": {"use": "opencv-sift"}, "levels": 1},
    ],
    ids=["single frames", "robust", "splat", "sift"],
)
def test_alternative_stages_accept_grey_frames(scored: Callable, sections: dict[str, Any]) -> None:
    """Measured: 0.08 px for keypoints, and less for the others."""
    score, _ = scored(camera(), camera(), oracle=False, **sections)
    assert score.trajectory.mean_px < 0.15


def test_explain_describes_capture_of_grey_frames(tmp_path: Path) -> None:
    spec = {"version": 1, "source": camera(), "resample": {"with": {"group_size": 4}}, "levels": 1}
    (tmp_path / "scan.yaml").write_text(json.dumps(spec))
    done = CliRunner().invoke(app, ["explain", str(tmp_path / "scan.yaml"), "--forecast"])
    assert done.exit_code == 0, done.output
    assert "on 90 8-bit frames of 128x160 at 500 Hz" in done.output
    assert "forecast from a trial" in done.output
