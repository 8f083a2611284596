"""A sensor with faults, corrected by its spec, gives the panorama of a sensor without."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from photonpano import FrameSpan, evaluate, run
from photonpano.api.cli.app import app
from photonpano.capture.writing import truth_path, write_packed
from photonpano.evaluation import Evaluation
from photonpano.execution.context import Context
from photonpano.merging.panorama import plan_canvas, render
from photonpano.pipeline.components import build_source
from photonpano.specs import parse_spec
from photonpano.testing import KnownMotion

pytestmark = pytest.mark.usefixtures("without_report")

SHAPE, N = (128, 160), 300
RAW = (132, 168)
GEOMETRY: list[Any] = [
    {"crop": {"rows": [4, None], "columns": [0, -8]}},
    {"swap-columns": {"first": [60, 64], "second": [68, 72]}},
    "rot180",
]
"""What undoes `as_read_out`."""


def as_read_out(path: Path) -> Path:
    """Write a capture as its sensor would: turned, with columns swapped, and with rows and columns that show nothing."""
    frames = np.rot90(np.unpackbits(np.load(path), axis=-1), 2, axes=(1, 2))
    raw = np.random.default_rng(0).integers(0, 2, (len(frames), *RAW), dtype=np.uint8)
    raw[:, 4:, :-8] = frames
    raw[:, 4:, 60:64], raw[:, 4:, 68:72] = frames[:, :, 68:72], frames[:, :, 60:64]
    np.save(path.with_name("raw.npy"), np.packbits(raw, axis=-1))
    return path.with_name("raw.npy")


def spec_of(path: Path, *corrections: Any) -> dict[str, Any]:
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(path)}},
        "corrections": list(corrections),
        "resample": {"with": {"group_size": 50}},
        "levels": 2,
        "refine": [],
    }


@pytest.fixture(scope="module")
def dark_rates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Dark counts that differ from pixel to pixel, and three pixels in a hundred that are hot."""
    rng = np.random.default_rng(7)
    rates = rng.lognormal(np.log(0.005), 0.5, SHAPE)
    hot = rng.random(SHAPE) < 0.03
    rates[hot] += rng.uniform(0.1, 2, int(hot.sum()))
    path = tmp_path_factory.mktemp("sensor") / "rates.npy"
    np.save(path, rates)
    return path


@pytest.fixture(scope="module")
def clean(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return scored(spec_of(small_capture), small_capture, tmp_path_factory.mktemp("clean"))


@pytest.fixture(scope="module")
def raw(simulated: Callable[..., Path], dark_rates: Path) -> Path:
    return as_read_out(simulated(sensor={"dark_rates": str(dark_rates)}))


@pytest.fixture(scope="module")
def dark_file(dark_rates: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `photonpano dark` makes of frames with the lens covered."""
    folder = tmp_path_factory.mktemp("dark")
    covered = {"flux": 1e-9, "n_frames": 2000, "frame_shape": list(SHAPE), "sensor": {"dark_rates": str(dark_rates)}, "seed": 3}
    with build_source(parse_spec({"version": 1, "source": {"use": "simulator", "with": covered}})) as source:
        write_packed(source, folder / "covered.npy")
    (folder / "covered.yaml").write_text(json.dumps(spec_of(as_read_out(folder / "covered.npy"), *GEOMETRY)))
    done = CliRunner().invoke(app, ["dark", str(folder / "covered.yaml"), "--output", str(folder / "dark.npz")])
    assert done.exit_code == 0, done.output
    return folder / "dark.npz"


def scored(spec: dict[str, Any], capture: Path, folder: Path) -> Evaluation:
    done = run(parse_spec(spec, output=folder / "run"))
    return evaluate(done.directory, truth_path(capture))


def mean_error_px(spec: dict[str, Any], capture: Path, folder: Path) -> float:
    done = run(parse_spec(spec, output=folder / "run"))
    return evaluate(done.directory, truth_path(capture), oracle=False).trajectory.mean_px


def test_corrected_sensor_is_as_accurate_as_one_without_faults(
    clean: Evaluation, raw: Path, dark_file: Path, small_capture: Path, tmp_path: Path
) -> None:
    """0.1 dB below it when this was written, and 1.8 dB if only the pixels are put in their places."""
    dark = {"dark": str(dark_file)}
    corrections = [*GEOMETRY, {"hot-pixels": dark}, {"dark-counts": dark}]
    corrected = scored(spec_of(raw, *corrections), small_capture, tmp_path / "corrected")
    assert clean.oracle.psnr_db - corrected.oracle.psnr_db < 0.2
    assert clean.panorama.psnr_db - corrected.panorama.psnr_db < 0.3
    moved = scored(spec_of(raw, *GEOMETRY), small_capture, tmp_path / "moved")
    assert moved.oracle.psnr_db < clean.oracle.psnr_db - 1
    record = json.loads((tmp_path / "corrected" / "run" / "run.json").read_text())
    assert [decision["what"] for decision in record["decisions"]][:2] == ["hot_pixels", "dark_counts_masked"]
    assert record["decisions"][0]["value"] == pytest.approx(0.03 * SHAPE[0] * SHAPE[1], rel=0.3)
    assert (record["source"]["height"], record["source"]["width"]) == SHAPE
    assert parse_spec(record["spec"]).corrections == parse_spec(spec_of(raw, *corrections)).corrections


def test_masked_pixel_is_filled_by_the_motion(small_capture: Path, tmp_path: Path) -> None:
    """Six columns are blind; other frames saw what they did not."""
    blind = np.zeros(SHAPE, bool)
    blind[:, 80:86] = True
    np.save(tmp_path / "blind.npy", blind)
    with np.load(truth_path(small_capture)) as truth:
        homographies = truth["homographies"]
    motion = KnownMotion(lambda frame: homographies[min(round(float(frame)), N - 1)])
    seen = {}
    for name, corrections in {"all": [], "masked": [{"mask": {"file": str(tmp_path / "blind.npy")}}]}.items():
        with build_source(parse_spec(spec_of(small_capture, *corrections))) as source:
            canvas = plan_canvas(motion, source.info.span, SHAPE, 1.0, 2**30)
            seen[name] = render(source, motion, source.info.span, canvas, 0.125, Context())
            first = source.counts(FrameSpan(0, 1))
    assert first[:, 80:86].any()
    everywhere, masked = seen["all"], seen["masked"]
    inside = everywhere.weight > 0.99 * N
    assert inside.sum() > 2000
    assert not np.isnan(masked.flux[inside]).any()
    fewer = inside & (masked.weight < 0.99 * everywhere.weight)
    assert fewer.sum() > 500
    known = everywhere.flux[fewer]
    off = masked.flux[fewer] - known
    # Photon noise of the frames that are missing, and no blur: an average over six columns would be off by far more.
    assert np.sqrt(np.mean(off**2)) < 0.12 * known.std()
    assert abs(off.mean()) < 0.01 * known.mean()


def test_unsuitable_correction_is_reported_at_its_place(small_capture: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "bad.npy", np.zeros((132, 168), bool))
    (tmp_path / "scan.yaml").write_text(
        "version: 1\n"
        f"source: {{use: packed-npy, with: {{path: {small_capture}}}}}\n"
        "corrections:\n"
        "  - crop: {rows: [4, null]}\n"
        "  - mask: {file: bad.npy}\n"
    )
    done = CliRunner().invoke(app, ["check", str(tmp_path / "scan.yaml")])
    assert done.exit_code == 2
    assert done.stderr == (
        f"{tmp_path}/scan.yaml:5:5: corrections.1: {tmp_path}/bad.npy has 132x168 px, and frames have 124x160 px at this "
        "place of the list\n"
        "error: the spec has 1 problem\n"
    )


def test_run_masks_hot_pixels_by_itself(simulated: Callable[..., Path], tmp_path: Path) -> None:
    """With them in it, the run locks onto the pixels, which do not move: 13 px off when this was written."""
    street = {"kind": "street", "width": 1024, "height": 682}  # its first houses: others have parts that a pan does not change
    capture = simulated(scene=street, flux=0.03, sensor={"hot_fraction": 0.1, "dark_rate": 0.001, "hot_rate": [0.3, 2.0]})
    spec = spec_of(capture)
    assert mean_error_px(spec, capture, tmp_path / "as-read") > 5
    del spec["corrections"]
    assert mean_error_px(spec, capture, tmp_path / "auto") < 1
    record = json.loads((tmp_path / "auto" / "run" / "run.json").read_text())
    assert record["spec"]["corrections"] == "auto"
    masked = next(each for each in record["decisions"] if each["what"] == "still_pixels")
    assert masked["value"] == pytest.approx(0.1 * SHAPE[0] * SHAPE[1], rel=0.15)
