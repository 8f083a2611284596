"""Panoramas of a simulated high-speed camera: 60 frames of 128x160 px at 500 Hz, 2.7 px a frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import evaluate, open_source, run
from photonpano.evaluation import Evaluation
from photonpano.specs import parse_spec

pytestmark = pytest.mark.usefixtures("without_report")

SHAKE = {"rms_px": 1.0, "frequencies_hz": [3, 5, 8]}
CAMERA = {
    "scene": {"kind": "street", "width": 1024, "height": 682},
    "path": {"kind": "pan", "length_px": 160, "angle_deg": 10, "shake": SHAKE},
    "n_frames": 60,
    "frame_shape": [128, 160],
}


def camera(light: float = 1, read_noise: float = 20) -> dict[str, Any]:
    """Return the source section of the simulated camera, with the light multiplied by a factor."""
    sensor = {"full_well": 10_000 * light, "read_noise": read_noise, "exposure": 0.5}
    return {"use": "camera-simulator", "with": CAMERA | {"flux": 1500 * light, "sensor": sensor}}


@cache
def taken(light: float, read_noise: float) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the frames of the camera, which take longer to simulate than to use, and their truth."""
    with open_source(parse_spec({"version": 1, "source": camera(light, read_noise)})) as opened:
        return opened.frames(opened.info.span), opened.truth()


@pytest.fixture
def scored(tmp_path: Path, write_video: Callable) -> Callable[..., tuple[Evaluation, dict[str, Any]]]:
    """Run a spec on a video of the camera, by default without loss, and return its scores and its record."""

    def scored(
        *how: str, light: float = 1, read_noise: float = 20, oracle: bool = False, crf: int | None = None, **sections: Any
    ) -> tuple[Evaluation, dict[str, Any]]:
        frames, truth = taken(light, read_noise)
        path = write_video(frames, *(how or ("lossless.mkv", "ffv1", "gray")), **({} if crf is None else {"crf": crf}))
        np.savez(tmp_path / "truth.npz", **truth)
        response = {"saturation_photons": 10_000 * light, "read_noise": read_noise}
        source = {"use": "video", "with": {"path": str(path), "frame_rate_hz": 500, "response": response}}
        result = run(parse_spec({"version": 1, "source": source, **sections}, output=tmp_path / "run"), overwrite=True)
        return evaluate(result.directory, tmp_path / "truth.npz", oracle=oracle), result.record

    return scored


def test_noisy_compressed_video_is_nearly_as_accurate_as_clean_one(scored: Callable) -> None:
    """Measured: 0.06 to 0.09 px for five seeds of the noise."""
    noisy, record = scored("noisy.mp4", "libx264", "yuvj420p", crf=23, oracle=True, levels=2)
    clean, _ = scored(light=100, read_noise=0, levels=2)
    assert clean.trajectory.mean_px < 0.1
    assert noisy.trajectory.mean_px < 0.12
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
        {"resample": {"with": {"group_size": 3}}, "merge": {"use": "local-flow"}, "levels": 2},
        {"resample": {"with": {"group_size": 5}}, "merge": {"use": "splat"}, "levels": 2},
        {"resample": {"use": "constant-groups", "with": {"group_size": 5}}, "locate": {"use": "opencv-sift"}, "levels": 1},
    ],
    ids=["single frames", "local flow", "splat", "sift"],
)
def test_alternative_stages_accept_grey_frames(scored: Callable, sections: dict[str, Any]) -> None:
    """Measured: 0.08 px for keypoints, and less for the others."""
    assert scored(**sections)[0].trajectory.mean_px < 0.15
